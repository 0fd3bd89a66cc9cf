// Whether anything lies along a ray. Body of a Warp native function; tracer_embree.py puts embree_ray.h before it.
const float from[3] = {origin[0], origin[1], origin[2]}, along[3] = {direction[0], direction[1], direction[2]};
const bool is_void = __builtin_fabsf(from[0]) > VOID_BEYOND;
return !is_void && is_blocked(from, along);
