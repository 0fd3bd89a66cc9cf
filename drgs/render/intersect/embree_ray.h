// One ray against a mesh by Embree, CPU only. Placed inside a native function's body that has `embree`, an EmbreeHandles (tracer_embree.py).
// RTCRayHit of Embree 4, with space for what builds of it may add behind.
struct alignas(16) RayHit {
    float origin[3], near, direction[3], time, far;
    unsigned mask, id, flags;
    float normal[3], u, v;
    unsigned triangle, geometry, spare[14];
};
typedef void (*IntersectFn)(void*, RayHit*, void*);
const auto prepare = [](RayHit& ray, const float* origin, const float* direction) {
    for (int k = 0; k < 3; ++k) {
        ray.origin[k] = origin[k];
        ray.direction[k] = direction[k];
    }
    ray.near = ray.time = 0.0f;
    ray.far = __builtin_huge_valf();
    ray.mask = ~0u;
    ray.id = ray.flags = 0;
};
// Whether there is a first hit within reach; it is then in `ray`.
const auto first_hit = [&](RayHit& ray, const float* origin, const float* direction, float reach = __builtin_huge_valf()) -> bool {
    prepare(ray, origin, direction);
    ray.far = reach;
    ray.triangle = ray.geometry = ~0u;
    for (int k = 0; k < 14; ++k) ray.spare[k] = ~0u;
    ((IntersectFn)embree.intersect_fn)((void*)embree.scene, &ray, nullptr);
    return ray.geometry != ~0u;
};
// Whether anything is in the way: then Embree sets `far` to minus infinity.
const auto is_blocked = [&](const float* origin, const float* direction) -> bool {
    RayHit ray;
    prepare(ray, origin, direction);
    ((IntersectFn)embree.occluded_fn)((void*)embree.scene, &ray, nullptr);
    return ray.far < 0.0f;
};
