// The first hits of camera rays through the middles of a block of four by four pixels, CPU only. Body of a Warp native function; tracer_embree.py
// puts simd_vector.h before it. Embree takes the sixteen rays together: neighbours go down the tree side by side.
//
// in   embree, view, x, y (the block's first pixel in the image)
// out  face and barycentric of the block's pixels that show something; how many do

// RTCRayHit16 of Embree 4, with space for what builds of it may add behind.
struct alignas(64) RayHits {
    v16 origin[3], near, direction[3], time, far;
    i16 mask, id, flags;
    v16 normal[3], u, v;
    i16 triangle, geometry, spare[6];
};
// The head of RTCIntersectArguments; Embree itself takes nothing for the rest of it.
struct alignas(16) Arguments {
    unsigned flags, features;
    void *context, *filter, *intersect, *spare[8];
};
typedef void (*IntersectFn)(const int*, void*, RayHits*, Arguments*);
const unsigned COHERENT = 1u << 16, ALL_FEATURES = ~0u;
const i16 lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const i16 column = x + (lane & 3), row = y + (lane >> 2);
const v16 u = __builtin_convertvector(column, v16) + 0.5f, v = __builtin_convertvector(row, v16) + 0.5f;
v16 along[3];
const auto& in_camera = view.camera_from_pixel.data;
const auto& in_world = view.world_from_camera.data;
v16 local[3];
for (int k = 0; k < 3; ++k) local[k] = in_camera[k][0] * u + in_camera[k][1] * v + in_camera[k][2];
for (int k = 0; k < 3; ++k) along[k] = in_world[k][0] * local[0] + in_world[k][1] * local[1] + in_world[k][2] * local[2];
const v16 scale = 1.0f / sqrt16(along[0] * along[0] + along[1] * along[1] + along[2] * along[2]);
RayHits rays;
for (int k = 0; k < 3; ++k) {
    rays.origin[k] = v16(view.center[k]);
    rays.direction[k] = along[k] * scale;
}
rays.near = rays.time = v16(0.0f);
rays.far = v16(__builtin_huge_valf());
rays.mask = rays.triangle = rays.geometry = i16(-1);
rays.id = rays.flags = i16(0);
for (int k = 0; k < 6; ++k) rays.spare[k] = i16(-1);
alignas(64) int valid[16];
*(i16*)valid = (column < view.image_width) & (row < view.image_height);
Arguments arguments = {COHERENT, ALL_FEATURES, nullptr, nullptr, nullptr, {}};
((IntersectFn)embree.intersect_sixteen_fn)(valid, (void*)embree.scene, &rays, &arguments);
int seen = 0;
for (int k = 0; k < 16; ++k) {
    if (valid[k] == 0 || rays.geometry[k] == -1) continue;
    const long at = (long)row[k] * view.image_width + column[k];
    face.data[at] = rays.triangle[k];
    ((float*)barycentric.data)[2 * at] = rays.u[k];
    ((float*)barycentric.data)[2 * at + 1] = rays.v[k];
    ++seen;
}
return seen;
