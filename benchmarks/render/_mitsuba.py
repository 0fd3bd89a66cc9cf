"""Mitsuba's path tracer: on the scenes of the integrator benchmark, for comparing time and error in the same run; and as a witness that is not ours.

The project's BRDF is none of Mitsuba's, so it is written here as a Mitsuba plugin: the formulas of drgs/maths/brdf.py, sampled as Mitsuba
samples its own (one lobe chosen by its share of the energy: visible GGX normals or the cosine). Dr.Jit compiles it together with
Mitsuba's integrator; nothing of ours runs. Light is sampled by Mitsuba's environment map, both combined by its path integrator.
A witness (`mitsuba_picture`) has Mitsuba's own principled BSDF instead, as the benchmark's scenes have.

Needs `pip install mitsuba==3.9.1`, LLVM 19 and DRJIT_LIBLLVM_PATH (docs/performance.md).
"""

import time
from typing import Any, Literal

import numpy as np

from drgs.maths.color_numpy import srgb_from_linear
from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.scene.camera import Camera, opengl_from_camera
from drgs.scene.mesh import TriangleMesh

Brdf = Literal["ours", "principled"]


class MitsubaScene:
    """A mesh under an environment, seen by one camera. Final."""

    def __init__(
        self, mesh: TriangleMesh, environment: np.ndarray, camera: Camera, bounces: int, turn_degrees: float = 0.0, brdf: Brdf = "ours"
    ) -> None:
        """
        Args:
            turn_degrees: of the light, counter-clockwise seen from above.

        Raises:
            ValueError: Mitsuba or its LLVM variant is not there.
        """
        self._mi = mi = load_mitsuba()
        if brdf == "ours":
            _register_brdf(mi)
        self._scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 2 + bounces, "rr_depth": 100, "hide_emitters": True},
                "sensor": mitsuba_sensor(mi, camera),
                "light": mitsuba_light(mi, environment, turn_degrees),
                "object": mitsuba_mesh(mi, mesh, brdf),
            }
        )

    def render(self, samples: int, seed: int) -> tuple[np.ndarray, float, float]:
        """(height, width, 3) premultiplied linear picture, wall seconds, seconds summed over threads."""
        started, cpu_started = time.perf_counter(), time.process_time()
        picture = self.render_rgba(samples, seed)
        return picture[..., :3], time.perf_counter() - started, time.process_time() - cpu_started

    def render_rgba(self, samples: int, seed: int) -> np.ndarray:
        """(height, width, 4) premultiplied linear colour, and coverage."""
        return np.array(self._mi.render(self._scene, spp=samples, seed=seed))


def mitsuba_picture(
    mesh: TriangleMesh, environment: np.ndarray, camera: Camera, samples: int, bounces: int, turn_degrees: float = 0.0
) -> np.ndarray:
    """(height, width, 4) straight alpha, sRGB, 0..1: a witness of which nothing but the mesh and its materials is ours."""
    picture = MitsubaScene(mesh, environment, camera, bounces, turn_degrees, "principled").render_rgba(samples, 0).astype(np.float64)
    alpha = picture[..., 3:].clip(0, 1)
    return np.concatenate([srgb_from_linear((picture[..., :3] / np.maximum(alpha, 1e-9)).clip(0, 1)), alpha], -1)


def load_mitsuba() -> Any:
    """The package, with its LLVM variant chosen.

    Raises:
        ValueError: one of them is not there.
    """
    try:
        import mitsuba as mi

        if mi.variant() is None:
            mi.set_variant("llvm_ad_rgb")
        import drjit as dr

        dr.eval(mi.Float(1.0) + 1)
    except (ImportError, RuntimeError) as error:
        raise ValueError(f"Mitsuba's pictures need mitsuba 3.9.1 with LLVM 19 and DRJIT_LIBLLVM_PATH set to it: {error}") from error
    return mi


def sensor_transform(mi: Any, camera: Camera) -> Any:
    """Mitsuba looks along +z, with x to the left."""
    return mi.ScalarTransform4f(opengl_from_camera(camera).numpy() @ np.diag([-1.0, 1.0, -1.0, 1.0]))


def mitsuba_sensor(mi: Any, camera: Camera) -> dict[str, Any]:
    """Looks through the middle of its picture, pixels are square and not filtered."""
    fov_x = 2 * np.degrees(np.arctan(0.5 * camera.width / float(camera.intrinsics[0, 0])))
    film = {
        "type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgba",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    return {
        "type": "perspective", "fov": float(fov_x), "fov_axis": "x", "to_world": sensor_transform(mi, camera),
        "film": film, "sampler": {"type": "independent"},
    }  # fmt: skip


def mitsuba_light(mi: Any, environment: np.ndarray, turn_degrees: float = 0.0) -> dict[str, Any]:
    """An environment map; Mitsuba's are y up.

    Args:
        turn_degrees: counter-clockwise seen from above.
    """
    y_up = mi.ScalarTransform4f(np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]))
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], turn_degrees)
    return {"type": "envmap", "bitmap": mi.Bitmap(environment.astype(np.float32)), "to_world": turn @ y_up}


def mitsuba_mesh(mi: Any, mesh: TriangleMesh, brdf: Brdf) -> Any:
    """With the mesh's normals and materials."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "drgs_brdf"} if brdf == "ours" else _principled())
    result = mi.Mesh("object", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mi.Float(mesh.vertices.numpy().ravel())
    parameters["vertex_normals"] = mi.Float(mesh.normals.numpy().ravel())
    parameters["faces"] = mi.UInt32(mesh.faces.numpy().astype(np.uint32).ravel())
    parameters.update()
    for name, values in (("albedo", mesh.albedo), ("roughness", mesh.roughness), ("metallic", mesh.metallic)):
        result.add_attribute(f"vertex_{name}", 3 if values.dim() == 2 else 1, values.numpy().ravel())
    return result


def _principled() -> dict[str, Any]:
    """Mitsuba's own, of the mesh's materials; its specular 0.5 is F0 = 0.04."""
    textures = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
    named = {name: {"type": "mesh_attribute", "name": f"vertex_{attribute}"} for name, attribute in textures.items()}
    return {"type": "principled", "specular": 0.5, **named}


def _register_brdf(mi: Any) -> None:
    import drjit as dr

    class Brdf(mi.BSDF):
        """(1 - metallic) albedo / pi + D V F, as design.md says."""

        def __init__(self, properties: Any) -> None:
            mi.BSDF.__init__(self, properties)
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def _material(self, si: Any, active: Any) -> tuple:
            albedo = si.shape.eval_attribute_3("vertex_albedo", si, active)
            metallic = si.shape.eval_attribute_1("vertex_metallic", si, active)
            roughness = dr.maximum(si.shape.eval_attribute_1("vertex_roughness", si, active), MIN_ROUGHNESS)
            f0 = F0 * (1 - metallic) + albedo * metallic
            diffuse = (1 - metallic) * dr.max(albedo)
            fresnel = dr.max(f0) + (1 - dr.max(f0)) * (1 - dr.maximum(mi.Frame3f.cos_theta(si.wi), 0)) ** 5
            share = dr.clip(fresnel / (fresnel + diffuse), 0.1, 1)
            return albedo * (1 - metallic), f0, dr.square(roughness), share

        def _value(self, si: Any, wo: Any, material: tuple, active: Any) -> tuple:
            diffuse, f0, alpha, share = material
            nv, nl = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active = active & (nv > 0) & (nl > 0)
            h = dr.normalize(si.wi + wo)
            a2 = dr.square(alpha)
            d = a2 / (dr.pi * dr.square(dr.square(h.x) + dr.square(h.y) + dr.square(h.z) * a2))
            v = 0.5 / dr.maximum(nl * dr.sqrt(nv * nv * (1 - a2) + a2) + nv * dr.sqrt(nl * nl * (1 - a2) + a2), 1e-12)
            c5 = (1 - dr.clip(dr.dot(h, si.wi), 0, 1)) ** 5
            value = (diffuse / dr.pi + (f0 + (1 - f0) * c5) * d * v) * nl
            g1 = 2 * nv / (nv + dr.sqrt(a2 + (1 - a2) * nv * nv))
            density = share * g1 * d / (4 * dr.maximum(nv, 1e-9)) + (1 - share) * nl / dr.pi
            return dr.select(active, value, 0), dr.select(active, density, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple:
            material = self._material(si, active)
            alpha, share = material[2], material[3]
            glossy = sample1 < share
            # Visible normals (Heitz 2018).
            v = dr.normalize(mi.Vector3f(alpha * si.wi.x, alpha * si.wi.y, si.wi.z))
            across = v.x * v.x + v.y * v.y
            t1 = dr.select(across > 1e-12, mi.Vector3f(-v.y, v.x, 0) * dr.rsqrt(dr.maximum(across, 1e-12)), mi.Vector3f(1, 0, 0))
            t2 = dr.cross(v, t1)
            r, phi = dr.sqrt(sample2.x), 2 * dr.pi * sample2.y
            p1, p2 = r * dr.cos(phi), r * dr.sin(phi)
            s = 0.5 * (1 + v.z)
            p2 = (1 - s) * dr.sqrt(dr.maximum(1 - p1 * p1, 0)) + s * p2
            n = p1 * t1 + p2 * t2 + dr.sqrt(dr.maximum(1 - p1 * p1 - p2 * p2, 0)) * v
            h = dr.normalize(mi.Vector3f(alpha * n.x, alpha * n.y, dr.maximum(n.z, 1e-9)))
            wo = dr.select(glossy, 2 * dr.dot(si.wi, h) * h - si.wi, mi.warp.square_to_cosine_hemisphere(sample2))
            value, density = self._value(si, wo, material, active)
            bs = mi.BSDFSample3f()
            bs.wo, bs.pdf, bs.eta = wo, density, 1.0
            bs.sampled_type, bs.sampled_component = mi.UInt32(+self.m_flags), mi.UInt32(0)
            return bs, dr.select(density > 0, value / dr.maximum(density, 1e-30), 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value(si, wo, self._material(si, active), active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value(si, wo, self._material(si, active), active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple:
            return self._value(si, wo, self._material(si, active), active)

        def to_string(self) -> str:
            return "drgs_brdf[]"

    mi.register_bsdf("drgs_brdf", lambda properties: Brdf(properties))
