"""Slow float64 twins of the kernels, with their names and signatures: the specification that tests and benchmarks hold them to.

path_integrator.py is the rendering equation in whole, for both integrators.
"""
