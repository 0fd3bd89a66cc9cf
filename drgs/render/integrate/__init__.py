"""What a point sends back towards the camera. In: shading points, environment, settings. Out: outgoing radiance and its variance.

Begin with integrator.py, the interface; wavefront.py and fused_embree.py implement it, and plan.py says what a frame leaves out.
"""
