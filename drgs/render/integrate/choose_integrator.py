"""Which integrator shades with a tracer's rays."""

from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import AbstractIntegrator
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeTracer


def choose_integrator(tracer: AbstractTracer) -> AbstractIntegrator:
    """The fastest one for a tracer; nothing else in the renderer asks which tracer it has."""
    if isinstance(tracer, EmbreeTracer):
        return FusedEmbreeIntegrator(tracer)
    from drgs.render.integrate.wavefront import WavefrontIntegrator  # here, with its kernels: where Embree traces, nobody needs them

    return WavefrontIntegrator(tracer)
