"""Which integrator shades with a tracer's rays."""

from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import AbstractIntegrator
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeTracer


def choose_integrator(tracer: AbstractTracer) -> AbstractIntegrator:
    """The fastest one for a tracer; nothing else in the renderer asks which tracer it has."""
    return FusedEmbreeIntegrator(tracer) if isinstance(tracer, EmbreeTracer) else WavefrontIntegrator(tracer)
