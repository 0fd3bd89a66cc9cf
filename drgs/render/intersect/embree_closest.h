// The first hit of a ray within reach: distance, triangle, weights of its second and third corner. Body of a Warp native function;
// tracer_embree.py puts embree_ray.h before it.
const float from[3] = {origin[0], origin[1], origin[2]}, along[3] = {direction[0], direction[1], direction[2]};
RayHit ray;
const bool is_void = __builtin_fabsf(from[0]) > VOID_BEYOND;
if (is_void || !first_hit(ray, from, along, reach)) return wp::vec_t<4, wp::float64>(__builtin_huge_val(), -1.0, 0.0, 0.0);
return wp::vec_t<4, wp::float64>((double)ray.far, (double)ray.triangle, (double)ray.u, (double)ray.v);
