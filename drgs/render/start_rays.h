// start_rays for 16 rays at once, CPU only. Body of a Warp native function; shade.py prepends ray_vector.h and what that needs.
// The Warp kernel start_rays in shade.py says the same ray by ray; a test keeps both equal.
// Lanes never look at each other, so a ray's result does not depend on its group.
//
// in   base (first ray of the group in the batch), ray_count (of the batch), first (the batch's first ray among all),
//      points, starts, surface_normals, start_face, horizon (8 of each face), light, samples, keep_dark
// out  cosine_weight, specular, radiance of rays base .. base + 15, and either their origin and direction,
//      or what they met: `blocked`, and with keep_dark the rays that met a surface, packed behind path_count[0] in `packed`

// 1. Gather the points of the group's rays.
const int count = samples.cosine + samples.ggx + samples.environment;
const int lanes = min_int(16, ray_count - base);
const float* const normals = (const float*)points.normal.data;
const float* const outgoing = (const float*)points.wo.data;
const float* const albedos = (const float*)points.albedo.data;
const float* const triangles = (const float*)surface_normals.data;
alignas(64) float gathered[14][16];
alignas(64) unsigned pixel_lane[16], index_lane[16], strategy_lane[16];
u16 pixel16, index16, strategy16;
int point_lane[16];
// Most groups stand on one point: what it says is read once.
const int first_lane_point = (first + base) / count, slot = first + base - first_lane_point * count;
if (slot + 16 <= count) {
    const int point = first_lane_point;
    int split[3];
    split_at(samples, points, point, split);
    const int round = samples.round + (points.round.shape[0] > 0 ? points.round.data[point] : 0);
    const u16 slots = LANE_NUMBERS + (unsigned)slot;
    const u16 cosine_end = u16((unsigned)split[0]), ggx_end = u16((unsigned)(split[0] + split[1]));
    const u16 is_ggx = __builtin_bit_cast(u16, slots >= cosine_end), is_table = __builtin_bit_cast(u16, slots >= ggx_end);
    strategy16 = (is_ggx & 1u) + (is_table & 1u);
    index16 = slots + (unsigned)(round * split[0]);
    index16 = is_ggx != 0u ? slots - cosine_end + (unsigned)(round * split[1]) : index16;
    index16 = is_table != 0u ? slots - ggx_end + (unsigned)(round * split[2]) : index16;
    pixel16 = u16((unsigned)points.pixel.data[point]);
    for (int lane = 0; lane < 16; ++lane) point_lane[lane] = point;
    for (int k = 0; k < 3; ++k) {
        store16(gathered[k], v16(normals[3 * (long)point + k]));
        store16(gathered[3 + k], v16(outgoing[3 * (long)point + k]));
        store16(gathered[6 + k], v16(triangles[3 * (long)point + k]));
        store16(gathered[11 + k], v16((float)split[k]));
    }
    store16(gathered[9], v16(points.roughness.data[point]));
    store16(gathered[10], v16(points.metallic.data[point]));
} else {
for (int lane = 0; lane < 16; ++lane) {
    const int ray = first + base + min_int(lane, lanes - 1), point = ray / count;
    int split[3];
    split_at(samples, points, point, split);
    const int round = samples.round + (points.round.shape[0] > 0 ? points.round.data[point] : 0);
    strategy_of(split, round, ray - point * count, strategy_lane[lane], index_lane[lane]);
    point_lane[lane] = point;
    pixel_lane[lane] = (unsigned)points.pixel.data[point];
    for (int k = 0; k < 3; ++k) {
        gathered[k][lane] = normals[3 * point + k];
        gathered[3 + k][lane] = outgoing[3 * point + k];
        gathered[6 + k][lane] = triangles[3 * point + k];
        gathered[11 + k][lane] = (float)split[k];
    }
    gathered[9][lane] = points.roughness.data[point];
    gathered[10][lane] = points.metallic.data[point];
}
    strategy16 = *(const u16*)strategy_lane;
    index16 = *(const u16*)index_lane;
    pixel16 = *(const u16*)pixel_lane;
}
const V3 n = {load16(gathered[0]), load16(gathered[1]), load16(gathered[2])};
const V3 wo = {load16(gathered[3]), load16(gathered[4]), load16(gathered[5])};
const Lobes lobes = lobes_of(n, wo, load16(gathered[9]));
const u16 strategy = strategy16;

// 2. Two numbers a ray.
v16 u0, u1;
sobol_pair(index16, hash_combine(hash_combine(u16(samples.seed), pixel16), strategy), u0, u1);

// 3. Directions: cosine and GGX for all lanes, the environment's table for those that ask for it.
const i16 is_environment = strategy == 2u;
V3 d = lobe_direction(lobes, u0, u1, strategy == 0u);
if (any(is_environment)) {
    const V3 drawn = draw_environment(light, u0, u1, is_environment);
    d = {select(is_environment, drawn.x, d.x), select(is_environment, drawn.y, d.y), select(is_environment, drawn.z, d.z)};
}
d = unit3(d);
const V3 triangle = {load16(gathered[6]), load16(gathered[7]), load16(gathered[8])};
const v16 n_dot_l = dot3(n, d), above = dot3(triangle, d);
i16 live = (lobes.n_dot_v > 0.0f) & (n_dot_l > 0.0f) & (above > 0.0f);

// 4. The environment there.
v16 seen[3];
const v16 table_pdf = look_up(light, d, live, seen);
if (keep_dark == 0) live &= max16(seen[0], max16(seen[1], seen[2])) > 0.0f;

// 5. Weight and specular reflection.
v16 ggx_pdf, dv, c5;
lobe_at(lobes, d, n_dot_l, ggx_pdf, dv, c5);
const v16 density = load16(gathered[11]) * n_dot_l * (1.0f / PI) + load16(gathered[12]) * ggx_pdf + load16(gathered[13]) * table_pdf;
live &= density > 0.0f;
const v16 w = select(live, n_dot_l / max16(density, v16(1e-37f)), v16(0.0f));
dv *= w;
alignas(64) int live_lane[16];
alignas(64) float result[14][16];
store16(result[0], select(live, d.x, v16(0.57735027f)));
store16(result[1], select(live, d.y, v16(0.57735027f)));
store16(result[2], select(live, d.z, v16(0.57735027f)));
store16(result[3], w);
store16(result[4], dv * (1.0f - c5));
store16(result[5], dv * c5);
for (int k = 0; k < 3; ++k) store16(result[6 + k], select(live, seen[k], v16(0.0f)));
*(i16*)live_lane = live;
alignas(64) int traced_lane[16], sector_lane[16];
alignas(64) float limit[16];
*(i16*)sector_lane = horizon_sector(triangle, d);
const bool has_horizons = horizon.shape[0] > 0;
for (int lane = 0; lane < lanes; ++lane) {
    const int face_there = has_horizons ? start_face.data[point_lane[lane]] : -1;
    limit[lane] = face_there >= 0 ? horizon.data[8 * (long)face_there + sector_lane[lane]] : 2.0f;
}
*(i16*)traced_lane = above <= load16(limit);
const float* const from = (const float*)starts.data;
float* const specular_out = (float*)specular.data;
float* const radiance_out = (float*)radiance.data;
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane, point = point_lane[lane];
    const float metal = gathered[10][lane];
    cosine_weight.data[ray] = result[3][lane];
    for (int k = 0; k < 3; ++k) {
        const float f0 = 0.04f * (1.0f - metal) + albedos[3 * point + k] * metal;
        specular_out[3 * ray + k] = result[4][lane] * f0 + result[5][lane];
        radiance_out[3 * ray + k] = result[6 + k][lane];
    }
}
// ----
// 6. The rays, for a tracer.
float* const origin_out = (float*)origin.data;
float* const direction_out = (float*)direction.data;
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane, point = point_lane[lane];
    for (int k = 0; k < 3; ++k) {
        // Rays that are void or meet nothing for certain leave from far outside, away from the mesh.
        const float outside = result[k][lane] < 0.0f ? -1.0e15f : 1.0e15f;
        origin_out[3 * ray + k] = live_lane[lane] != 0 && traced_lane[lane] != 0 ? from[3 * point + k] : outside;
        direction_out[3 * ray + k] = result[k][lane];
    }
}
// ----
// 6. What they meet. A launch runs on one thread from its first index to its last, so rays that met something pack themselves in order.
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane;
    bool met = false;
    if (live_lane[lane] != 0 && traced_lane[lane] != 0) {
        const float along[3] = {result[0][lane], result[1][lane], result[2][lane]};
        const float* const start = from + 3 * (long)point_lane[lane];
        if (keep_dark == 0) {
            met = is_blocked(occluded, start, along);
        } else {
            RayHit found;
            met = first_hit(intersect, found, start, along);
            if (met) {
                const int path = path_count.data[0]++;
                packed.ray.data[path] = ray;
                packed.face.data[path] = (int)found.triangle;
                ((float*)packed.barycentric.data)[2 * path] = found.u;
                ((float*)packed.barycentric.data)[2 * path + 1] = found.v;
                for (int k = 0; k < 3; ++k) {
                    ((float*)packed.arriving.data)[3 * path + k] = along[k];
                    ((float*)packed.throughput.data)[3 * path + k] = 1.0f;
                    ((float*)indirect.data)[3 * ray + k] = 0.0f;
                }
            }
        }
    }
    blocked.data[ray] = met;
}
