"""Poses of plain pictures. In: a folder of photographs. Out: a posed capture of the nerfstudio layout.

Begin with pose_photographs.py. list_photos.py says what is there, prepare_photos.py turns pictures upright, run_colmap.py finds the poses in a
process of its own that colmap_process.py starts and stops, upright_world.py chooses the world's axes, posed_capture.py writes the result, and
explain_failure.py says why there is none.
"""
