// The kernel sample_directions of sample_rays.py for 16 rays at once, CPU only. Body of a Warp native function; sample_sixteen.py puts ray_vector.h
// before it. Lanes never look at each other, so a ray's result does not depend on its group. Tests hold it to the reference.
//
// in   base (first ray of the group), ray_count, points, light, samples
// out  direction and weight of rays base .. base + 15

// 1. The points of the group's rays: each is read once for all its lanes, and the next one overwrites the lanes from its first on.
const int count = samples.cosine + samples.ggx + samples.environment;
const int lanes = min_int(16, ray_count - base);
const float* const normals = (const float*)points.normal.data;
const float* const outgoing = (const float*)points.wo.data;
v16 normal_at[3], wo_at[3], split_there[3], roughness = v16(0.0f);
for (int k = 0; k < 3; ++k) normal_at[k] = wo_at[k] = split_there[k] = v16(0.0f);
u16 pixel = u16(0u), index = u16(0u), strategy = u16(0u);
for (int lane = 0; lane < lanes;) {
    const int ray = base + lane, point = ray / count, slot = ray - point * count;
    const long at = 3 * (long)point;
    const i16 here = __builtin_bit_cast(i16, LANE_NUMBERS) >= lane;
    int split[3];
    split_at(samples, points, point, split);
    // strategy_of sample_rays.py
    const i16 slots = __builtin_bit_cast(i16, LANE_NUMBERS) + (slot - lane);
    const i16 is_ggx = slots >= split[0], is_table = slots >= split[0] + split[1];
    i16 number = slots + samples.round * split[0];
    number = is_ggx ? slots + (samples.round * split[1] - split[0]) : number;
    number = is_table ? slots + (samples.round * split[2] - split[0] - split[1]) : number;
    strategy = here ? __builtin_bit_cast(u16, -(is_ggx + is_table)) : strategy;
    index = here ? __builtin_bit_cast(u16, number) : index;
    pixel = here ? u16((unsigned)points.pixel.data[point]) : pixel;
    for (int k = 0; k < 3; ++k) {
        normal_at[k] = select(here, v16(normals[at + k]), normal_at[k]);
        wo_at[k] = select(here, v16(outgoing[at + k]), wo_at[k]);
        split_there[k] = select(here, v16((float)split[k]), split_there[k]);
    }
    roughness = select(here, v16(points.roughness.data[point]), roughness);
    lane = min_int(16, lane + count - slot);
}
const V3 n = {normal_at[0], normal_at[1], normal_at[2]};
const Lobes lobes = lobes_of(n, {wo_at[0], wo_at[1], wo_at[2]}, roughness);

// 2. Two numbers a ray, and its direction.
v16 u0, u1;
sobol_pair(index, hash_combine(hash_combine(u16(samples.seed), pixel), strategy), u0, u1);
const i16 is_environment = strategy == 2u;
V3 d = lobe_direction(lobes, u0, u1, strategy == 0u);
if (any(is_environment)) {
    const V3 drawn = draw_environment(light, u0, u1, is_environment);
    d = {select(is_environment, drawn.x, d.x), select(is_environment, drawn.y, d.y), select(is_environment, drawn.z, d.z)};
}
const i16 faces = lobes.n_dot_v > 0.0f;
d = unit3({select(faces, d.x, n.x), select(faces, d.y, n.y), select(faces, d.z, n.z)});

// 3. Its weight.
const v16 n_dot_l = dot3(n, d);
i16 live = faces & (n_dot_l > 0.0f);
v16 seen[3], ggx_pdf, dv, c5;
const v16 table_pdf = look_up(light, d, live & (split_there[2] > 0.0f), seen);
lobe_at(lobes, d, n_dot_l, ggx_pdf, dv, c5);
const v16 density = split_there[0] * n_dot_l * (1.0f / PI) + split_there[1] * ggx_pdf + split_there[2] * table_pdf;
live &= density > 0.0f;
alignas(64) float result[4][16];
store16(result[0], d.x);
store16(result[1], d.y);
store16(result[2], d.z);
store16(result[3], select(live, 1.0f / max16(density, v16(1e-37f)), v16(0.0f)));
float* const direction_out = (float*)direction.data;
for (int lane = 0; lane < lanes; ++lane) {
    const long ray = (long)base + lane;
    for (int k = 0; k < 3; ++k) direction_out[3 * ray + k] = result[k][lane];
    weight.data[ray] = result[3][lane];
}
