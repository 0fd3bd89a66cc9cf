// The kernel scatter_hits of trace_indirect.py, and the tracing of its rays, for 16 paths at once, CPU only. Body of a Warp native function;
// fused_embree.py puts embree_ray.h and ray_vector.h before it. Tests hold both integrators to each other, and to the reference.
//
// in   base (first path of the group), first_point (of the chunk), depth, is_last (paths end here), points, scene, samples,
//      and the paths: with an even depth scratch.even, else scratch.odd
// out  scratch.rays.indirect plus the light of rays that met nothing; paths that go on, packed in the other of both behind its count;
//      scratch.counts[2] plus the rays traced

// 1. The surfaces that the group's paths met.
const auto& mesh = scene.mesh;
const auto& from = depth % 2 == 0 ? scratch.even : scratch.odd;
const auto& onto = depth % 2 == 0 ? scratch.odd : scratch.even;
const int paths = scratch.counts.data[depth % 2], onto_side = 1 - depth % 2;
const int count = samples.cosine + samples.ggx + samples.environment;
const int lanes = min_int(16, paths - base);
const float* const positions = (const float*)mesh.vertices.data;
const float* const normals = (const float*)mesh.normals.data;
const float* const albedos = (const float*)mesh.albedo.data;
alignas(64) float corner[3][11][16], uv_lane[2][16], arriving[3][16], carried[3][16];
alignas(64) unsigned pixel_lane[16], index_lane[16], strategy_lane[16];
int triangles[16], pool_lane[16];
// Corners of the next group's triangles lie anywhere in memory: they are asked for now, and the triangles of the one after it.
for (int path = base + 16; path < min_int(base + 32, paths); ++path) {
    const int* const corners = mesh.faces.data + 3 * (long)from.face.data[path];
    for (int c = 0; c < 3; ++c) {
        __builtin_prefetch(positions + 3 * (long)corners[c]);
        __builtin_prefetch(normals + 3 * (long)corners[c]);
        __builtin_prefetch(albedos + 3 * (long)corners[c]);
        __builtin_prefetch(mesh.roughness.data + corners[c]);
        __builtin_prefetch(mesh.metallic.data + corners[c]);
    }
}
for (int path = base + 32; path < min_int(base + 48, paths); ++path) __builtin_prefetch(mesh.faces.data + 3 * (long)from.face.data[path]);
for (int lane = 0; lane < 16; ++lane) {
    const int path = base + min_int(lane, lanes - 1), triangle = from.face.data[path];
    triangles[lane] = triangle;
    for (int c = 0; c < 3; ++c) {
        const long vertex = mesh.faces.data[3 * (long)triangle + c];
        for (int k = 0; k < 3; ++k) {
            corner[c][k][lane] = positions[3 * vertex + k];
            corner[c][3 + k][lane] = normals[3 * vertex + k];
            corner[c][6 + k][lane] = albedos[3 * vertex + k];
        }
        corner[c][9][lane] = mesh.roughness.data[vertex];
        corner[c][10][lane] = mesh.metallic.data[vertex];
    }
    const float* const weights = (const float*)from.barycentric.data + 2 * (long)path;
    uv_lane[0][lane] = weights[0];
    uv_lane[1][lane] = weights[1];
    for (int k = 0; k < 3; ++k) {
        arriving[k][lane] = ((const float*)from.arriving.data)[3 * (long)path + k];
        carried[k][lane] = ((const float*)from.throughput.data)[3 * (long)path + k];
    }
    const int ray = (int)from.ray.data[path], listed = first_point + ray / count;
    const int point = points.order.shape[0] > 0 ? points.order.data[listed] : listed;
    int split[3];
    split_at(samples, points, point, split);
    const int round = samples.round + (points.round.shape[0] > 0 ? points.round.data[point] : 0);
    strategy_of(split, round, ray % count, strategy_lane[lane], index_lane[lane]);
    pool_lane[lane] = points.pool.shape[0] > 0 ? points.pool.data[point] : round;
    pixel_lane[lane] = (unsigned)points.pixel.data[point];
}
const v16 second = load16(uv_lane[0]), third = load16(uv_lane[1]), one = 1.0f - second - third;
const auto blend = [&](int k) -> v16 { return one * load16(corner[0][k]) + second * load16(corner[1][k]) + third * load16(corner[2][k]); };
const auto edge = [&](int c) -> V3 {
    return {load16(corner[c][0]) - load16(corner[0][0]), load16(corner[c][1]) - load16(corner[0][1]), load16(corner[c][2]) - load16(corner[0][2])};
};
const V3 position = {blend(0), blend(1), blend(2)}, n = unit3({blend(3), blend(4), blend(5)}), outward = unit3(cross3(edge(1), edge(2)));
const v16 albedo[3] = {blend(6), blend(7), blend(8)}, metallic = blend(10);
const V3 wo = {-load16(arriving[0]), -load16(arriving[1]), -load16(arriving[2])};
const Lobes lobes = lobes_of(n, wo, blend(9));
const i16 outside = (lobes.n_dot_v > 0.0f) & (dot3(outward, wo) > 0.0f);

// 2. Numbers, of a stream for each depth.
const u16 index = *(const u16*)index_lane;
const u16 stream = hash_combine(hash_combine(u16(samples.seed), *(const u16*)pixel_lane), *(const u16*)strategy_lane);
const auto numbers = [&](unsigned purpose, v16& u0, v16& u1) {
    const u16 seed = hash_combine(stream, u16(purpose + 4u * (unsigned)depth));
    sobol_pair(shuffle_index(index, seed), seed, u0, u1);
};

// 3. The lobe is chosen by its share of the reflected energy, Fresnel at the viewing angle.
const v16 c = 1.0f - lobes.n_dot_v, c2 = c * c, fresnel = c2 * c2 * c;
const v16 largest = max16(albedo[0], max16(albedo[1], albedo[2]));
const v16 f0 = max16(F0 * (1.0f - metallic) + largest * metallic, v16(1e-3f));
const v16 mirrored = f0 + (1.0f - f0) * fresnel;
const v16 share = min16(max16(mirrored / (mirrored + (1.0f - metallic) * largest), v16(0.1f)), v16(1.0f));

// Throughput times BRDF times cosine of light from d, and the density of the BRDF's own samples there.
const auto reflect = [&](V3 d, v16 n_dot_l, v16* reflected) -> v16 {
    v16 pdf, dv, c5;
    lobe_at(lobes, d, n_dot_l, pdf, dv, c5);
    for (int k = 0; k < 3; ++k) {
        const v16 base_reflectance = F0 * (1.0f - metallic) + albedo[k] * metallic;
        const v16 diffuse = albedo[k] * ((1.0f - metallic) * (1.0f / PI));
        reflected[k] = load16(carried[k]) * n_dot_l * (diffuse + dv * (base_reflectance * (1.0f - c5) + c5));
    }
    return share * pdf + (1.0f - share) * n_dot_l * (1.0f / PI);
};

float total[16][3] = {};
// Trace rays in direction d: `light_there` is what each brings if it meets nothing, `carried_on` the throughput of paths that follow it.
const auto trace = [&](i16 live, V3 d, const v16* light_there, const v16* carried_on) {
    alignas(64) float out[12][16];
    alignas(64) int live_lane[16], traced_lane[16], sector_lane[16];
    alignas(64) float limit[16];
    *(i16*)live_lane = live;
    *(i16*)sector_lane = horizon_sector(outward, d);
    for (int lane = 0; lane < 16; ++lane) limit[lane] = mesh.horizon.shape[0] > 0 ? mesh.horizon.data[8 * (long)triangles[lane] + sector_lane[lane]] : 2.0f;
    *(i16*)traced_lane = dot3(outward, d) <= load16(limit);
    const V3 start = {position.x + mesh.lift * outward.x, position.y + mesh.lift * outward.y, position.z + mesh.lift * outward.z};
    store16(out[0], start.x); store16(out[1], start.y); store16(out[2], start.z);
    store16(out[3], d.x); store16(out[4], d.y); store16(out[5], d.z);
    for (int k = 0; k < 3; ++k) {
        store16(out[6 + k], light_there[k]);
        if (carried_on != nullptr) store16(out[9 + k], carried_on[k]);
    }
    for (int lane = 0; lane < lanes; ++lane) {
        if (live_lane[lane] != 0) {
            const float start_there[3] = {out[0][lane], out[1][lane], out[2][lane]}, along[3] = {out[3][lane], out[4][lane], out[5][lane]};
            bool met = false;
            scratch.counts.data[2] += traced_lane[lane] != 0;
            if (traced_lane[lane] != 0 && (is_last || carried_on == nullptr)) {
                met = is_blocked(start_there, along);
            } else if (traced_lane[lane] != 0) {
                RayHit found;
                met = first_hit(found, start_there, along);
                if (met && (out[9][lane] > 0.0f || out[10][lane] > 0.0f || out[11][lane] > 0.0f)) {
                    const int path = scratch.counts.data[onto_side]++;
                    onto.ray.data[path] = from.ray.data[base + lane];
                    onto.face.data[path] = (int)found.triangle;
                    ((float*)onto.barycentric.data)[2 * path] = found.u;
                    ((float*)onto.barycentric.data)[2 * path + 1] = found.v;
                    for (int k = 0; k < 3; ++k) {
                        ((float*)onto.arriving.data)[3 * path + k] = along[k];
                        ((float*)onto.throughput.data)[3 * path + k] = out[9 + k][lane];
                    }
                }
            }
            if (!met) {
                for (int k = 0; k < 3; ++k) total[lane][k] += out[6 + k][lane];
            }
        }
        if (carried_on != nullptr) {  // the last of both
            float* const sum = (float*)scratch.rays.indirect.data + 3 * from.ray.data[base + lane];
            for (int k = 0; k < 3; ++k) sum[k] += total[lane][k];
        }
    }
};

// 4. Towards the environment.
v16 u0, u1, reflected[3], incoming[3];
numbers(16u, u0, u1);
const bool chooses = samples.candidates > 1 && depth == 0;
const float candidates = chooses ? (float)samples.candidates : 1.0f;
V3 d;
v16 n_dot_l, table_pdf, chosen_weight = v16(1.0f);
i16 live;
if (chooses) {
    alignas(64) float choice[8][16] = {};  // direction, radiance and density of what was chosen, and the factor of its weight
    alignas(64) int outside_lane[16];
    alignas(64) unsigned block_lane[16];
    alignas(64) float u_lane[16], share_lane[16];
    *(i16*)outside_lane = outside;
    *(u16*)block_lane = block_of(hash_combine(stream, u16(16u)), index);
    store16(u_lane, u0);
    store16(share_lane, share);
    const Places places = places_of(lobes, outward, albedo, metallic);
    const float* blocks[16];
    for (int lane = 0; lane < lanes; ++lane) {  // all are asked for before the first is needed
        blocks[lane] = pool_block(scene.pools, pool_lane[lane], 1, block_lane[lane]);
        for (int k = 0; k < 8 && outside_lane[lane] != 0; ++k) __builtin_prefetch(blocks[lane] + 16 * k);
    }
    for (int lane = 0; lane < lanes; ++lane) {
        if (outside_lane[lane] == 0) continue;
        const float* const block = blocks[lane];
        const float shares[3] = {1.0f - share_lane[lane], share_lane[lane], candidates};
        const int chosen = choose_candidate(block, places, lane, shares, 0.0f, u_lane[lane], choice[7][lane]);
        for (int k = 0; k < 7 && chosen >= 0; ++k) choice[k][lane] = block[16 * k + chosen];
    }
    d = {load16(choice[0]), load16(choice[1]), load16(choice[2])};
    n_dot_l = dot3(n, d);
    chosen_weight = load16(choice[7]);
    live = outside & (chosen_weight > 0.0f) & (n_dot_l > 0.0f) & (dot3(outward, d) > 0.0f);
    for (int k = 0; k < 3; ++k) incoming[k] = load16(choice[3 + k]);
    table_pdf = load16(choice[6]);
} else {
    d = draw_environment(scene.light, u0, u1, outside);
    n_dot_l = dot3(n, d);
    live = outside & (n_dot_l > 0.0f) & (dot3(outward, d) > 0.0f);
    table_pdf = look_up(scene.light, d, live, incoming);
}
v16 density = reflect(d, n_dot_l, reflected) + candidates * table_pdf;
live &= density > 0.0f;
for (int k = 0; k < 3; ++k) incoming[k] *= reflected[k] * chosen_weight / max16(density, v16(1e-37f));
trace(live, d, incoming, nullptr);

// 5. Along one of the lobes, and on.
v16 which, chance;
numbers(18u, which, chance);
numbers(17u, u0, u1);
d = unit3(lobe_direction(lobes, u0, u1, which >= share));
n_dot_l = dot3(n, d);
live = outside & (n_dot_l > 0.0f) & (dot3(outward, d) > 0.0f);
table_pdf = look_up(scene.light, d, live, incoming);
const v16 own = reflect(d, n_dot_l, reflected);
live &= own > 0.0f;
v16 onward[3], survival = v16(1.0f);
if (depth > 0) {
    survival = min16(max16(max16(reflected[0], max16(reflected[1], reflected[2])) / max16(own, v16(1e-37f)), v16(0.05f)), v16(1.0f));
}
for (int k = 0; k < 3; ++k) {
    incoming[k] *= reflected[k] / max16(own + candidates * table_pdf, v16(1e-37f));
    onward[k] = select(chance < survival, reflected[k] / max16(own * survival, v16(1e-37f)), v16(0.0f));
}
trace(live, d, incoming, onward);
