"""Where each surfel sits on the mesh, and where it goes when the mesh moves; also which surfels are near a point, for baking.

In: centres and a triangle mesh. Out: a Binding (closest face, barycentrics, signed distance along its normal). It does
not know how frames and tangents follow a moved face: that is drgs/deform. Source: DR-GS algorithm 1, step 2
(docs/sources.md), by Warp's closest-point query on both devices.
"""

import torch
import warp as wp
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.scene.binding import Binding
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, thread_count, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.kernel
def query_closest_faces(
    first: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    max_distance: float,
    # outputs
    face: wp.array[int],
    barycentric: wp.array[wp.vec3],
):
    i = first + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], max_distance)
    if query.result:
        face[i] = query.face
        barycentric[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
    else:
        face[i] = -1


def bind_gaussians(centers: Float[Tensor, "surfel 3"], mesh: TriangleMesh) -> Binding:
    """Binding of centres (N, 3) to the closest points of a mesh.

    Raises:
        ValueError: the mesh has no faces with area, or a centre is not finite.
    """
    if mesh.faces.shape[0] == 0:
        raise ValueError("cannot bind Gaussians to a mesh without faces")
    corners = mesh.vertices[mesh.faces.long()]
    if not torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any():
        raise ValueError("cannot bind Gaussians to a mesh whose faces all have no area")
    finite = torch.isfinite(centers).all(-1)
    if not finite.all():
        raise ValueError(f"cannot bind Gaussians: {int((~finite).sum())} of {centers.shape[0]} centres are not finite")
    device = centers.device
    count = centers.shape[0]
    face = torch.zeros(count, dtype=torch.int32, device=device)
    barycentric = torch.zeros(count, 3, device=device)
    if count == 0:
        return Binding(face, barycentric, torch.zeros(0, device=device))
    # Warp's mesh reads these arrays in place: they must outlive the launch.
    vertices, faces = mesh.vertices.to(device).float().contiguous(), mesh.faces.to(device).int().contiguous()
    tree = wp.Mesh(points=warp_array(vertices, wp.vec3), indices=warp_array(faces.reshape(-1)))
    points = centers.detach().float().contiguous()
    everything = torch.cat([points, vertices])
    reach = 2.0 * float((everything.amax(0) - everything.amin(0)).norm()) + 1e-6
    launch(
        query_closest_faces,
        count,
        inputs=[tree.id, warp_array(points, wp.vec3), reach],
        outputs=[warp_array(face), warp_array(barycentric, wp.vec3)],
        device=warp_device(points),
    )
    barycentric = barycentric.clamp(min=0.0)
    barycentric = barycentric / barycentric.sum(-1, keepdim=True)
    on_face, normal = foot_and_normal(face, barycentric, vertices, faces)
    return Binding(face, barycentric, ((points - on_face) * normal).sum(-1))


def points_from_binding(binding: Binding, vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Float[Tensor, "surfel 3"]:
    """(N, 3) bound points on a mesh with these vertices (V, 3) and faces (F, 3); differentiable in vertices and offsets.

    With the vertices that were bound to, a centre comes back exactly when its projection falls inside its face. When the
    closest point lies on an edge or corner (outside a ridge, or beyond an open border), the distance across the normal
    is not stored: the point comes back displaced along the face by at most its distance to the mesh.
    """
    on_face, normal = foot_and_normal(binding.face, binding.barycentric.to(vertices.dtype), vertices, faces)
    return on_face + binding.normal_offset.to(vertices.dtype)[:, None] * normal


def foot_and_normal(
    face: Int[Tensor, "surfel"], barycentric: Float[Tensor, "surfel 3"], vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> tuple[Float[Tensor, "surfel 3"], Float[Tensor, "surfel 3"]]:
    """Points (N, 3) at barycentrics (N, 3) and unit normals (N, 3) of their faces; zero normals for faces without area."""
    corners = vertices[faces.long()[face.long()]]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (corners * barycentric[..., None]).sum(1), torch.nn.functional.normalize(cross, dim=-1, eps=1e-30)


def nearest_surfels(
    points: Float[Tensor, "point 3"], centers: Float[Tensor, "surfel 3"], k: int
) -> tuple[Int[Tensor, "point {k}"], Float[Tensor, "point {k}"]]:
    """The k centres (N, 3) nearest to each point (P, 3): indices (P, k) int64 and distances (P, k), nearest first.

    Raises:
        ValueError: fewer than k centres, or k < 1.
    """
    if not 1 <= k <= centers.shape[0]:
        raise ValueError(f"asked for the {k} nearest of {centers.shape[0]} surfels; expected 1 to {centers.shape[0]}")
    tree = cKDTree(centers.detach().double().cpu().numpy())
    distances, indices = tree.query(points.detach().double().cpu().numpy(), k=[*range(1, k + 1)], workers=thread_count())
    return torch.from_numpy(indices).to(points.device), torch.from_numpy(distances).to(points)
