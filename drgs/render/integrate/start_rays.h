// The kernel start_rays of wavefront.py, and the tracing of its rays, for 16 rays at once, CPU only. Body of a Warp native function;
// fused_embree.py puts embree_ray.h and ray_vector.h before it. Tests hold both integrators to each other, and to the reference.
// Lanes never look at each other, so a ray's result does not depend on its group.
//
// in   base (first ray of the group in the chunk), ray_count (of the chunk), first (the chunk's first ray among all), bounces,
//      points (those that are meant, in their order), starts, scene, samples, remembered.known
// out  of rays base .. base + 15: scratch.rays without `indirect`; with bounces the rays that met a surface, packed in scratch.even
//      behind scratch.counts[0], their `indirect` set to 0; scratch.counts[2] plus the rays traced; remembered.kept, where there is space

// 1. The points of the group's rays: each is read once for all its lanes, and the next one overwrites the lanes from its first on.
const int count = samples.cosine + samples.ggx + samples.environment;
const int lanes = min_int(16, ray_count - base);
const float* const normals = (const float*)points.normal.data;
const float* const outgoing = (const float*)points.wo.data;
const float* const albedos = (const float*)points.albedo.data;
const float* const triangles = (const float*)starts.surface_normal.data;
v16 normal_at[3], wo_at[3], triangle_at[3], albedo_at[3], split_there[3], roughness = v16(0.0f), metal = v16(0.0f);
for (int k = 0; k < 3; ++k) normal_at[k] = wo_at[k] = triangle_at[k] = albedo_at[k] = split_there[k] = v16(0.0f);
u16 pixel = u16(0u), index = u16(0u), strategy = u16(0u);
int point_lane[16], pool_lane[16];
for (int lane = 0; lane < lanes;) {
    const int ray = first + base + lane, listed = ray / count, slot = ray - listed * count;
    const int point = points.order.shape[0] > 0 ? points.order.data[listed] : listed;
    const long at = 3 * (long)point;
    const i16 here = __builtin_bit_cast(i16, LANE_NUMBERS) >= lane;
    int split[3];
    split_at(samples, points, point, split);
    const int round = samples.round + (points.round.shape[0] > 0 ? points.round.data[point] : 0);
    // strategy_of sample_rays.py
    const i16 slots = __builtin_bit_cast(i16, LANE_NUMBERS) + (slot - lane);
    const i16 is_ggx = slots >= split[0], is_table = slots >= split[0] + split[1];
    i16 number = slots + round * split[0];
    number = is_ggx ? slots + (round * split[1] - split[0]) : number;
    number = is_table ? slots + (round * split[2] - split[0] - split[1]) : number;
    strategy = here ? __builtin_bit_cast(u16, -(is_ggx + is_table)) : strategy;
    index = here ? __builtin_bit_cast(u16, number) : index;
    pixel = here ? u16((unsigned)points.pixel.data[point]) : pixel;
    for (int k = 0; k < 3; ++k) {
        normal_at[k] = select(here, v16(normals[at + k]), normal_at[k]);
        wo_at[k] = select(here, v16(outgoing[at + k]), wo_at[k]);
        triangle_at[k] = select(here, v16(triangles[at + k]), triangle_at[k]);
        albedo_at[k] = select(here, v16(albedos[at + k]), albedo_at[k]);
        split_there[k] = select(here, v16((float)split[k]), split_there[k]);
    }
    roughness = select(here, v16(points.roughness.data[point]), roughness);
    metal = select(here, v16(points.metallic.data[point]), metal);
    for (const int end = min_int(16, lane + count - slot); lane < end; ++lane) {
        point_lane[lane] = point;
        pool_lane[lane] = points.pool.shape[0] > 0 ? points.pool.data[point] : round;
    }
}
const V3 n = {normal_at[0], normal_at[1], normal_at[2]}, triangle = {triangle_at[0], triangle_at[1], triangle_at[2]};
const Lobes lobes = lobes_of(n, {wo_at[0], wo_at[1], wo_at[2]}, roughness);

// 2. Two numbers a ray.
v16 u0, u1;
const u16 stream = hash_combine(hash_combine(u16(samples.seed), pixel), strategy);
sobol_pair(index, stream, u0, u1);

// 3. Directions: cosine and GGX for all lanes, the environment's table in the lanes that drew it, or the best of a block of its pool.
const i16 is_environment = strategy == 2u;
V3 d = lobe_direction(lobes, u0, u1, strategy == 0u);
const bool chooses = samples.candidates > 1;
const v16 environment_share = split_there[2] * (float)samples.candidates;
alignas(64) float choice[8][16] = {};  // direction, radiance and density of what was chosen, and the factor of its weight
if (chooses && any(is_environment)) {
    alignas(64) int choosing_lane[16];
    alignas(64) unsigned block_lane[16];
    alignas(64) float u_lane[16], share_lane[3][16];
    *(i16*)choosing_lane = is_environment & (lobes.n_dot_v > 0.0f);
    *(u16*)block_lane = block_of(stream, index);
    store16(u_lane, u0);
    store16(share_lane[0], split_there[0]);
    store16(share_lane[1], split_there[1]);
    store16(share_lane[2], environment_share);
    const Places places = places_of(lobes, triangle, albedo_at, metal);
    const float* blocks[16];
    for (int lane = 0; lane < lanes; ++lane) {  // all are asked for before the first is needed
        blocks[lane] = pool_block(scene.pools, pool_lane[lane], 0, block_lane[lane]);
        for (int k = 0; k < 8 && choosing_lane[lane] != 0; ++k) __builtin_prefetch(blocks[lane] + 16 * k);
    }
    for (int lane = 0; lane < lanes; ++lane) {
        if (choosing_lane[lane] == 0) continue;
        const float* const block = blocks[lane];
        const float shares[3] = {share_lane[0][lane], share_lane[1][lane], share_lane[2][lane]};
        // With the floor even where no bounces follow: the same rays with and without them say what they add.
        const int chosen = choose_candidate(block, places, lane, shares, 1.0f, u_lane[lane], choice[7][lane]);
        for (int k = 0; k < 7 && chosen >= 0; ++k) choice[k][lane] = block[16 * k + chosen];
    }
    d = {select(is_environment, load16(choice[0]), d.x), select(is_environment, load16(choice[1]), d.y), select(is_environment, load16(choice[2]), d.z)};
} else if (any(is_environment)) {
    const V3 drawn = draw_environment(scene.light, u0, u1, is_environment);
    d = {select(is_environment, drawn.x, d.x), select(is_environment, drawn.y, d.y), select(is_environment, drawn.z, d.z)};
}
d = unit3(d);
const v16 n_dot_l = dot3(n, d), above = dot3(triangle, d);
i16 live = (lobes.n_dot_v > 0.0f) & (n_dot_l > 0.0f) & (above > 0.0f);

// 4. The environment there.
v16 seen[3];
v16 table_pdf;
if (chooses) {
    live &= ~is_environment | (load16(choice[7]) > 0.0f);
    table_pdf = select(is_environment, load16(choice[6]), look_up(scene.light, d, live & ~is_environment, seen));
    for (int k = 0; k < 3; ++k) seen[k] = select(is_environment, load16(choice[3 + k]), seen[k]);
} else {
    table_pdf = look_up(scene.light, d, live, seen);
}
if (bounces == 0) live &= max16(seen[0], max16(seen[1], seen[2])) > 0.0f;

// 5. Weight and specular reflection.
v16 ggx_pdf, dv, c5;
lobe_at(lobes, d, n_dot_l, ggx_pdf, dv, c5);
const v16 density = split_there[0] * n_dot_l * (1.0f / PI) + split_there[1] * ggx_pdf + environment_share * table_pdf;
live &= density > 0.0f;
v16 w = select(live, n_dot_l / max16(density, v16(1e-37f)), v16(0.0f));
if (chooses) w = select(is_environment, w * load16(choice[7]), w);
dv *= w;
alignas(64) int live_lane[16];
alignas(64) float result[10][16];
store16(result[0], select(live, d.x, v16(0.57735027f)));
store16(result[1], select(live, d.y, v16(0.57735027f)));
store16(result[2], select(live, d.z, v16(0.57735027f)));
store16(result[3], w);
for (int k = 0; k < 3; ++k) {
    store16(result[4 + k], dv * ((1.0f - c5) * (F0 * (1.0f - metal) + albedo_at[k] * metal) + c5));
    store16(result[7 + k], select(live, seen[k], v16(0.0f)));
}
*(i16*)live_lane = live;
alignas(64) int traced_lane[16], sector_lane[16];
alignas(64) float limit[16];
*(i16*)sector_lane = horizon_sector(triangle, d);
const bool has_horizons = scene.mesh.horizon.shape[0] > 0 && starts.face.shape[0] > 0;
for (int lane = 0; lane < lanes; ++lane) {
    const int face_there = has_horizons ? starts.face.data[point_lane[lane]] : -1;
    limit[lane] = face_there >= 0 ? scene.mesh.horizon.data[8 * (long)face_there + sector_lane[lane]] : 2.0f;
}
*(i16*)traced_lane = above <= load16(limit);
const float* const from = (const float*)starts.origin.data;
float* const specular_out = (float*)scratch.rays.specular.data;
float* const radiance_out = (float*)scratch.rays.radiance.data;
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane;
    scratch.rays.cosine_weight.data[ray] = result[3][lane];
    for (int k = 0; k < 3; ++k) {
        specular_out[3 * ray + k] = result[4 + k][lane];
        radiance_out[3 * ray + k] = result[7 + k][lane];
    }
}

// 6. What they meet, where it is not known from before. A launch runs on one thread from its first index to its last, so rays that met
// something pack themselves in order.
const auto& known = remembered.known;
const auto& kept = remembered.kept;
const auto& paths = scratch.even;
const bool has_known = known.hit.shape[0] > 0, keeps = kept.hit.shape[0] > 0, keeps_surfaces = kept.face.shape[0] > 0;
const bool finds_surfaces = bounces > 0;
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane;
    const long number = (long)first + ray;
    const bool traced = live_lane[lane] != 0 && traced_lane[lane] != 0;
    const float along[3] = {result[0][lane], result[1][lane], result[2][lane]};
    const float* const start = from + 3 * (long)point_lane[lane];
    bool met = false, is_known = false;
    int triangle = -1;
    float weights[2] = {0.0f, 0.0f};
    // Known of all points, though only some be meant.
    const long number_known = (long)point_lane[lane] * count + number % count;
    if (traced && has_known) {
        const float* const before = (const float*)known.direction.data + 3 * number_known;
        is_known = before[0] == along[0] && before[1] == along[1] && before[2] == along[2];
    }
    if (is_known) {
        met = known.hit.data[number_known];
        if (met && finds_surfaces) {
            triangle = known.face.data[number_known];
            weights[0] = ((const float*)known.barycentric.data)[2 * number_known];
            weights[1] = ((const float*)known.barycentric.data)[2 * number_known + 1];
        }
    } else if (traced && !finds_surfaces) {
        scratch.counts.data[2]++;
        met = is_blocked(start, along);
    } else if (traced) {
        scratch.counts.data[2]++;
        RayHit found;
        met = first_hit(found, start, along);
        if (met) {
            triangle = (int)found.triangle;
            weights[0] = found.u;
            weights[1] = found.v;
        }
    }
    scratch.rays.blocked.data[ray] = met;
    if (met && finds_surfaces) {
        const int path = scratch.counts.data[0]++;
        paths.ray.data[path] = ray;
        paths.face.data[path] = triangle;
        for (int k = 0; k < 2; ++k) ((float*)paths.barycentric.data)[2 * path + k] = weights[k];
        for (int k = 0; k < 3; ++k) {
            ((float*)paths.arriving.data)[3 * path + k] = along[k];
            ((float*)paths.throughput.data)[3 * path + k] = 1.0f;
            ((float*)scratch.rays.indirect.data)[3 * ray + k] = 0.0f;
        }
    }
    if (keeps) {
        for (int k = 0; k < 3; ++k) ((float*)kept.direction.data)[3 * number + k] = traced ? along[k] : __builtin_nanf("");
        kept.hit.data[number] = met;
        if (keeps_surfaces) {
            kept.face.data[number] = triangle;
            for (int k = 0; k < 2; ++k) ((float*)kept.barycentric.data)[2 * number + k] = weights[k];
        }
    }
}
