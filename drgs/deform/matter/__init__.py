"""Simulated matter moves an object. In: an asset and a SimulationScene (simulation_scene.py). Out: ClipFrames (drgs/deform/clip.py).

Begin with simulate.py: fill_particles.py (with measure_thickness.py) puts particles into the mesh, measure_solid.py makes what they collide with,
mpm/ moves them, part_matter.py sees where they have come apart, and show_grains.py shows that to a renderer. What a simulation has made so far is
in simulation_progress.py, and by checkpoint_simulation.py on disk.
"""
