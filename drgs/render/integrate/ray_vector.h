// What start_rays.h and scatter_hits.h share: random numbers, directions, lobes and the environment for 16 rays side by side. Placed at
// the head of a native function's body, after simd_vector.h and the constants.
typedef unsigned u16 __attribute__((ext_vector_type(16)));
const float PI = 3.14159265358979f;
const u16 LANE_NUMBERS = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const auto to_float = [](u16 x) -> v16 { return __builtin_convertvector(__builtin_bit_cast(i16, x), v16); };
const auto floor16 = [](v16 a) { return __builtin_elementwise_floor(a); };
const auto hash32 = [](u16 x) -> u16 {
    x = (x ^ (x >> 16)) * 0x7FEB352Du;
    x = (x ^ (x >> 15)) * 0x846CA68Bu;
    return x ^ (x >> 16);
};
const auto hash_combine = [&](u16 seed, u16 value) -> u16 { return hash32(seed ^ hash32(value + 0x9E3779B9u)); };
const auto reverse_bits = [](u16 x) -> u16 {
    x = ((x & 0x55555555u) << 1) | ((x >> 1) & 0x55555555u);
    x = ((x & 0x33333333u) << 2) | ((x >> 2) & 0x33333333u);
    x = ((x & 0x0F0F0F0Fu) << 4) | ((x >> 4) & 0x0F0F0F0Fu);
    x = ((x & 0x00FF00FFu) << 8) | ((x >> 8) & 0x00FF00FFu);
    return (x << 16) | (x >> 16);
};
const auto scramble_reversed = [](u16 x, u16 seed) -> u16 {
    x = x ^ (x * 0x3D20ADEAu);
    x = x + seed;
    x = x * ((seed >> 16) | 1u);
    x = x ^ (x * 0x05526C56u);
    return x ^ (x * 0x53A22864u);
};
// sin and cos of 2 pi u: quarter turns taken off, then polynomials on an eighth to either side; error 3e-9 before rounding
const auto sincos_turns = [](v16 u, v16& sine, v16& cosine) {
    const v16 quarters = __builtin_elementwise_roundeven(u * 4.0f);
    const v16 f = u - quarters * 0.25f, f2 = f * f;
    const v16 s = f * (6.28318529f + f2 * (-41.3416626f + f2 * (81.5925482f + f2 * -75.4018403f)));
    const v16 c = 1.0f + f2 * (-19.7392087f + f2 * (64.9393162f + f2 * (-85.4428484f + f2 * 59.2202882f)));
    const i16 q = __builtin_convertvector(quarters, i16) & 3;
    const i16 odd = (q & 1) != 0;
    const v16 a = odd ? c : s, b = odd ? s : c;
    sine = (q >= 2) ? -a : a;
    cosine = ((q == 1) | (q == 2)) ? -b : b;
};
// atan2 / 2 pi, in (-0.5, 0.5]; error 2e-9 before rounding
const auto atan2_turns = [](v16 y, v16 x) -> v16 {
    const v16 ax = __builtin_elementwise_abs(x), ay = __builtin_elementwise_abs(y);
    const v16 high = __builtin_elementwise_max(ax, ay), low = __builtin_elementwise_min(ax, ay);
    const v16 s = low / __builtin_elementwise_max(high, v16(1e-30f)), s2 = s * s;
    v16 p = s2 * 0.0028340643f + -0.0160050305f;
    p = p * s2 + 0.0425876075f;
    p = p * s2 + -0.0749544544f;
    p = p * s2 + 0.106367541f;
    p = p * s2 + -0.142025705f;
    p = p * s2 + 0.199924836f;
    p = p * s2 + -0.333330668f;
    p = p * s2 + 0.999999984f;
    v16 turns = p * s * 0.159154943f;
    turns = ay > ax ? 0.25f - turns : turns;
    turns = x < 0.0f ? 0.5f - turns : turns;
    return y < 0.0f ? -turns : turns;
};
struct V3 { v16 x, y, z; };
const auto dot3 = [](V3 a, V3 b) -> v16 { return a.x * b.x + a.y * b.y + a.z * b.z; };
const auto cross3 = [](V3 a, V3 b) -> V3 { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; };
const auto scaled3 = [](V3 a, v16 s) -> V3 { return {a.x * s, a.y * s, a.z * s}; };
const auto unit3 = [&](V3 a) -> V3 { return scaled3(a, 1.0f / sqrt16(max16(dot3(a, a), v16(1e-30f)))); };
// Two numbers in [0, 1): Owen-scrambled Sobol.
const auto sobol_pair = [&](u16 index, u16 seed, v16& u0, v16& u1) {
    u16 second = u16(0u), row = u16(1u), bits = index;
    while (__builtin_reduce_or(bits) != 0u) {
        second = (bits & 1u) != 0u ? second ^ row : second;
        row = row ^ (row << 1);
        bits = bits >> 1;
    }
    u0 = to_float(reverse_bits(scramble_reversed(index, hash32(seed))) >> 8) * 5.9604645e-08f;
    u1 = to_float(reverse_bits(scramble_reversed(second, hash32(seed ^ 0x68BC21EBu))) >> 8) * 5.9604645e-08f;
};
const auto shuffle_index = [&](u16 index, u16 seed) -> u16 { return reverse_bits(scramble_reversed(reverse_bits(index), hash32(seed))); };
// split_at of sample_rays.py: cosine, GGX and environment samples of a point
const auto split_at = [&](const auto& samples, const auto& points, int point, int* split) {
    const int count = samples.cosine + samples.ggx + samples.environment;
    split[0] = samples.cosine;
    split[1] = samples.ggx;
    split[2] = samples.environment;
    if (samples.by_material == 0) return;
    const float* const albedo = (const float*)points.albedo.data + 3 * (long)point;
    const float metal = points.metallic.data[point];
    const float largest = albedo[0] > albedo[1] ? (albedo[0] > albedo[2] ? albedo[0] : albedo[2]) : (albedo[1] > albedo[2] ? albedo[1] : albedo[2]);
    const float diffuse = (1.0f - metal) * largest, mirror_like = F0 * (1.0f - metal) + metal * largest;
    const float sum = diffuse + mirror_like, share = diffuse / (sum > 1e-6f ? sum : 1e-6f);
    split[0] = min_int((int)((float)samples.cosine * share + 0.5f), count - 1);
    const float clamped = 1.0f - 4.0f * points.roughness.data[point];
    const float mirror = (1.0f - share) * (clamped > 0.0f ? (clamped < 1.0f ? clamped : 1.0f) : 0.0f);
    split[2] = min_int(max_int((int)((float)samples.environment * (1.0f - mirror) + 0.5f), 1), samples.environment);
    split[1] = count - split[0] - split[2];
};
// strategy_of of sample_rays.py: a sample's strategy, and its number in the sequence of that strategy
const auto strategy_of = [](const int* split, int round, int slot, unsigned& strategy, unsigned& index) {
    strategy = slot < split[0] ? 0u : (slot < split[0] + split[1] ? 1u : 2u);
    const int before = strategy == 0u ? 0 : (strategy == 1u ? split[0] : split[0] + split[1]);
    index = (unsigned)(round * split[strategy] + slot - before);
};
// horizon_sector of horizon_kernels.py
const auto horizon_sector = [&](V3 n, V3 d) -> i16 {
    const v16 scale = 1.0f / sqrt16(max16(n.x * n.x + n.y * n.y, v16(1e-30f)));
    const V3 u = {-n.y * scale, n.x * scale, v16(0.0f)};
    const v16 x = dot3(u, d), y = dot3(cross3(n, u), d);
    return ((x < 0.0f) & 1) | ((y < 0.0f) & 2) | ((__builtin_elementwise_abs(y) > __builtin_elementwise_abs(x)) & 4);
};
// A point's lobes seen from wo. `bound` and `stretch` belong to the density of visible normals.
struct Lobes { V3 n, wo; v16 alpha, alpha2, n_dot_v, bound, stretch; };
const auto lobes_of = [&](V3 n, V3 wo, v16 roughness) -> Lobes {
    Lobes l;
    l.n = n;
    l.wo = wo;
    const v16 clamped = max16(roughness, v16(MIN_ROUGHNESS));
    l.alpha = clamped * clamped;
    l.alpha2 = l.alpha * l.alpha;
    l.n_dot_v = dot3(n, wo);
    const v16 sin2 = max16(1.0f - l.n_dot_v * l.n_dot_v, v16(0.0f));
    const v16 reach = 1.0f + sqrt16(sin2), reach2 = reach * reach;
    l.bound = (1.0f - l.alpha2) * reach2 / (reach2 + l.alpha2 * l.n_dot_v * l.n_dot_v);
    l.stretch = sqrt16(l.alpha2 * sin2 + l.n_dot_v * l.n_dot_v);
    return l;
};
// Cosine direction in some lanes, else that of a visible normal; not normalised.
const auto lobe_direction = [&](const Lobes& l, v16 u0, v16 u1, i16 is_cosine) -> V3 {
    const V3 n = l.n;
    const v16 sign = n.z >= 0.0f ? v16(1.0f) : v16(-1.0f);
    const v16 frame_a = -1.0f / (sign + n.z);
    const V3 t = {1.0f + sign * n.x * n.x * frame_a, sign * n.x * n.y * frame_a, -sign * n.x}, b = cross3(n, t);
    const v16 local_x = dot3(t, l.wo), local_y = dot3(b, l.wo);
    v16 sine, cosine;
    sincos_turns(u1, sine, cosine);
    const v16 scale = 1.0f / sqrt16(max16(l.alpha2 * (local_x * local_x + local_y * local_y) + l.n_dot_v * l.n_dot_v, v16(1e-30f)));
    const v16 sx = l.alpha * local_x * scale, sy = l.alpha * local_y * scale, sz = l.n_dot_v * scale;
    const v16 cap_z = 1.0f - u0 * (1.0f + l.bound * sz);
    const v16 cap_r = sqrt16(max16(1.0f - cap_z * cap_z, v16(0.0f)));
    const V3 m = unit3({l.alpha * (cap_r * cosine + sx), l.alpha * (cap_r * sine + sy), cap_z + sz});
    const v16 twice = 2.0f * (local_x * m.x + local_y * m.y + l.n_dot_v * m.z);
    const v16 disc = sqrt16(u0);
    const v16 lx = select(is_cosine, disc * cosine, twice * m.x - local_x);
    const v16 ly = select(is_cosine, disc * sine, twice * m.y - local_y);
    const v16 lz = select(is_cosine, sqrt16(max16(1.0f - u0, v16(0.0f))), twice * m.z - l.n_dot_v);
    return {lx * t.x + ly * b.x + lz * n.x, lx * t.y + ly * b.y + lz * n.y, lx * t.z + ly * b.z + lz * n.z};
};
// Density of visible-normal samples at d, D V of the BRDF there, and Schlick's fifth power.
const auto lobe_at = [&](const Lobes& l, V3 d, v16 n_dot_l, v16& pdf, v16& dv, v16& c5) {
    const V3 h = unit3({d.x + l.wo.x, d.y + l.wo.y, d.z + l.wo.z});
    const v16 n_dot_h = dot3(l.n, h);
    const V3 across = cross3(l.n, h);
    const v16 denominator = dot3(across, across) + n_dot_h * n_dot_h * l.alpha2;
    const v16 ggx = l.alpha2 / max16(PI * denominator * denominator, v16(1e-30f));
    pdf = select(n_dot_h > 0.0f, ggx / (2.0f * (l.bound * l.n_dot_v + l.stretch)), v16(0.0f));
    const v16 nl = max16(n_dot_l, v16(1e-6f)), nv = max16(l.n_dot_v, v16(1e-6f));
    const v16 lambda = nl * sqrt16(nv * nv * (1.0f - l.alpha2) + l.alpha2) + nv * sqrt16(nl * nl * (1.0f - l.alpha2) + l.alpha2);
    dv = ggx * 0.5f / max16(lambda, v16(1e-12f));
    const v16 c = 1.0f - min16(max16(dot3(h, l.wo), v16(0.0f)), v16(1.0f));
    const v16 c2 = c * c;
    c5 = c2 * c2 * c;
};
// block_of and pool_place of environment_pool.py: where a block's numbers begin
const auto pool_block = [&](const auto& pools, int round, int pool, unsigned block) -> const float* {
    return pools.numbers.data + (((long)(round - pools.first_round) * 2 + pool) * BLOCKS + block) * (8 * 16);
};
const auto block_of = [&](u16 stream, u16 index) -> u16 { return (hash_combine(stream, u16((unsigned)BLOCK_STREAM)) + index) % (unsigned)BLOCKS; };
// What choose_candidate reads of 16 places, lane by lane: normal, wo, the surface's normal, diffuse BRDF, reflectance at the normal, alpha^2,
// n.wo, a factor of the density of visible normals, and the part of Smith's lambda that does not depend on the direction.
struct Places { float number[19][16]; };
const auto places_of = [&](const Lobes& l, V3 surface, const v16* albedo, v16 metal) -> Places {
    Places p;
    const v16 diffuse = (1.0f - metal) * (1.0f / PI), base = F0 * (1.0f - metal), nv = max16(l.n_dot_v, v16(1e-6f));
    const v16 all[19] = {l.n.x, l.n.y, l.n.z, l.wo.x, l.wo.y, l.wo.z, surface.x, surface.y, surface.z,
                         albedo[0] * diffuse, albedo[1] * diffuse, albedo[2] * diffuse,
                         base + albedo[0] * metal, base + albedo[1] * metal, base + albedo[2] * metal,
                         l.alpha2, nv, 0.5f / (l.bound * l.n_dot_v + l.stretch), sqrt16(nv * nv * (1.0f - l.alpha2) + l.alpha2)};
    for (int k = 0; k < 19; ++k) store16(p.number[k], all[k]);
    return p;
};
// choose_candidate of environment_pool.py for one lane's place: the 16 candidates of its block side by side. Which is taken, and the sum of
// all shares over its own; -1 and 0 if none can bring light. Half of lobe_at's roots and divisions: nothing is normalised that need not be.
const auto choose_candidate = [&](const float* block, const Places& p, int lane, const float* shares, float floor, float u, float& weight) -> int {
    const auto at = [&](int k) -> float { return p.number[k][lane]; };
    const V3 d = {load16(block), load16(block + 16), load16(block + 32)};
    const v16 n_dot_l = at(0) * d.x + at(1) * d.y + at(2) * d.z, above = at(6) * d.x + at(7) * d.y + at(8) * d.z;
    const i16 possible = (n_dot_l > 0.0f) & (above > 0.0f);
    weight = 0.0f;
    if (!any(possible)) return -1;
    const float alpha2 = at(15), nv = at(16);
    const V3 h = {d.x + at(3), d.y + at(4), d.z + at(5)};  // of length 2 h.wo
    const V3 across = cross3({v16(at(0)), v16(at(1)), v16(at(2))}, h);
    const v16 length2 = max16(dot3(h, h), v16(1e-30f)), n_dot_h = n_dot_l + nv;
    const v16 spread = dot3(across, across) + n_dot_h * n_dot_h * alpha2;
    const v16 ggx = alpha2 * length2 * length2 / max16(PI * spread * spread, v16(1e-30f));
    const v16 c = max16(1.0f - 0.5f * sqrt16(length2), v16(0.0f)), c2 = c * c, c5 = c2 * c2 * c;
    const v16 lambda = max16(n_dot_l * at(18) + nv * sqrt16(n_dot_l * n_dot_l * (1.0f - alpha2) + alpha2), v16(1e-12f));
    const v16 density = shares[0] * n_dot_l * (1.0f / PI) + shares[1] * at(17) * ggx + shares[2] * load16(block + 96);
    const v16 least = floor * load16(block + 112);
    v16 diffuse = v16(0.0f), at_normal = v16(0.0f), all = v16(0.0f);
    for (int k = 0; k < 3; ++k) {
        const v16 light = load16(block + 48 + 16 * k) + least;
        diffuse += at(9 + k) * light;
        at_normal += at(12 + k) * light;
        all += light;
    }
    const v16 brought = diffuse * lambda + 0.5f * ggx * (at_normal + (all - at_normal) * c5);
    const v16 q = select(possible & (density > 0.0f), brought * n_dot_l / max16(density * lambda, v16(1e-37f)), v16(0.0f));
    const v16 none = v16(0.0f);
    v16 sum = q;  // running, by doubling
    sum += __builtin_shufflevector(none, sum, 0, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
    sum += __builtin_shufflevector(none, sum, 0, 1, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29);
    sum += __builtin_shufflevector(none, sum, 0, 1, 2, 3, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27);
    sum += __builtin_shufflevector(none, sum, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
    const v16 before = __builtin_shufflevector(none, sum, 0, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
    const float total = sum[15];
    const i16 reached = (q > 0.0f) & (before <= u * total);
    const int chosen = __builtin_reduce_max(reached ? __builtin_bit_cast(i16, LANE_NUMBERS) : i16(-1));
    if (chosen >= 0) {
        alignas(64) float own[16];
        store16(own, q);
        weight = total / own[chosen];
    }
    return chosen;
};
// Index of the last of `count` running sums that is at most `target`. `coarse` holds 16 of them, `stride` apart; at(i) loads 16 from i on.
const auto last_sum_below = [&](v16 coarse, int stride, int count, float target, const auto& at) -> int {
    int low = stride * (-__builtin_reduce_add(coarse <= target) - 1);
    low = max_int(low, 0);
    for (int span = stride / 2; span >= 16; span /= 2)
        if (low + span < count && at(low + span)[0] <= target) low += span;
    low += -__builtin_reduce_add(at(low) <= target) - 1;
    return min_int(max_int(low, 0), count - 2);
};
// Directions drawn from the environment's table, in the lanes that want one.
const auto draw_environment = [&](const auto& light, v16 u0, v16 u1, i16 wanted) -> V3 {
    const int height = light.height, width = light.width, pitch = light.column_sums.shape[1];
    const float* const rows = light.row_sums.data;
    const v4* const texels = (const v4*)light.texels.data;
    // By lane: sums of a cell's rows or columns up to it and in it, and the densities at its two ends.
    alignas(64) float before[16] = {0}, mass[16] = {0}, start[16] = {0}, end[16] = {0}, target[16], between[16];
    alignas(64) int row[16] = {0}, column[16] = {0}, wanted_lane[16];
    alignas(64) float every[16];
    for (int k = 0; k < 16; ++k) every[k] = rows[min_int(k * light.row_stride, light.row_sums.shape[0] - 1)];
    const v16 coarse_rows = load16(every);
    *(i16*)wanted_lane = wanted;
    const v16 row_target = u0 * rows[height + 1];
    store16(target, row_target);
    for (int lane = 0; lane < 16; ++lane) {
        if (wanted_lane[lane] == 0) continue;
        const int r = last_sum_below(coarse_rows, light.row_stride, height + 2, target[lane], [&](int i) { return load16(rows + i); });
        row[lane] = r;
        before[lane] = rows[r];
        mass[lane] = rows[r + 1] - rows[r];
        start[lane] = light.column_sums.data[(long)r * pitch + width];
        end[lane] = light.column_sums.data[(long)(r + 1) * pitch + width];
    }
    const auto sample_linear = [&](v16 u, v16 a, v16 b) -> v16 {
        return u * (a + b) / max16(a + sqrt16(max16(a * a + u * (b * b - a * a), v16(0.0f))), v16(1e-37f));
    };
    const auto place_in_cell = [&](v16 sum) -> v16 {
        const v16 share = (sum - load16(before)) / max16(load16(mass), v16(1e-37f));
        return sample_linear(min16(max16(share, v16(0.0f)), v16(1.0f)), load16(start), load16(end));
    };
    const v16 t = place_in_cell(row_target), r = __builtin_convertvector(*(const i16*)row, v16);
    const v16 y = select(r == 0.0f, 0.5f * t, select(r == (float)height, r - 0.5f + 0.5f * t, r - 0.5f + t));
    const v16 column_target = u1 * (load16(start) * (1.0f - t) + load16(end) * t);
    store16(between, t);
    store16(target, column_target);
    for (int lane = 0; lane < 16; ++lane) {
        if (wanted_lane[lane] == 0) continue;
        const float part = between[lane], rest = 1.0f - part;
        const float* const upper = light.column_sums.data + (long)row[lane] * pitch;
        const float* const lower = upper + pitch;
        const float* const coarse = light.coarse_column_sums.data + 16 * (long)row[lane];
        const auto mixed = [&](const float* a, const float* b) -> v16 { return load16(a) * rest + load16(b) * part; };
        const int low = last_sum_below(mixed(coarse, coarse + 16), light.column_stride, width + 1, target[lane],
                                       [&](int i) { return mixed(upper + i, lower + i); });
        const int next = low + 1 == width ? 0 : low + 1;
        const v4* const top = texels + (long)row[lane] * width;
        column[lane] = low;
        before[lane] = upper[low] * rest + lower[low] * part;
        mass[lane] = upper[low + 1] * rest + lower[low + 1] * part - before[lane];
        start[lane] = top[low][3] * rest + top[width + low][3] * part;
        end[lane] = top[next][3] * rest + top[width + next][3] * part;
    }
    const v16 azimuth = 0.5f - (__builtin_convertvector(*(const i16*)column, v16) + 0.5f + place_in_cell(column_target)) / (float)width;
    v16 sin_azimuth, cos_azimuth, sin_polar, cos_polar;
    sincos_turns(azimuth, sin_azimuth, cos_azimuth);
    sincos_turns(0.5f * y / (float)height, sin_polar, cos_polar);
    const v16 ex = cos_azimuth * sin_polar, ey = sin_azimuth * sin_polar;
    return {light.cos_rotation * ex - light.sin_rotation * ey, light.sin_rotation * ex + light.cos_rotation * ey, cos_polar};
};
// Radiance and density of the environment, both bilinear; 0 in lanes that do not want it.
const auto look_up = [&](const auto& light, V3 d, i16 wanted, v16* seen) -> v16 {
    const int height = light.height, width = light.width;
    const float total = light.row_sums.data[height + 1];
    const v16 turned_x = light.cos_rotation * d.x + light.sin_rotation * d.y, turned_y = light.cos_rotation * d.y - light.sin_rotation * d.x;
    const v16 sin_polar = sqrt16(d.x * d.x + d.y * d.y);
    const v16 u = 0.5f - atan2_turns(turned_y, turned_x), v = 2.0f * atan2_turns(sin_polar, d.z);
    const v16 x = u * (float)width - 0.5f, x0 = floor16(x);
    const v16 y = v * (float)height + 0.5f, row = min16(max16(floor16(y), v16(0.0f)), v16((float)height));
    v16 t = y - row;
    t = select(row == 0.0f, 2.0f * (y - 0.5f), t);
    t = select(row == (float)height, 2.0f * (y - row), t);
    alignas(64) int column_lane[16], row_lane[16], wanted_lane[16];
    alignas(64) float x_lane[16], y_lane[16];
    *(i16*)column_lane = __builtin_convertvector(x0, i16);
    *(i16*)row_lane = __builtin_convertvector(row, i16);
    *(i16*)wanted_lane = wanted;
    store16(x_lane, x - x0);
    store16(y_lane, min16(max16(t, v16(0.0f)), v16(1.0f)));
    const v4* const texels = (const v4*)light.texels.data;
    alignas(64) v4 found[16];
    for (int lane = 0; lane < 16; ++lane) {
        found[lane] = v4(0.0f);
        if (wanted_lane[lane] == 0) continue;
        int c0 = column_lane[lane];
        c0 = c0 < 0 ? c0 + width : (c0 >= width ? c0 - width : c0);
        const int c1 = c0 + 1 == width ? 0 : c0 + 1;
        const v4* const top = texels + (long)row_lane[lane] * width;
        const float fx = x_lane[lane], fy = y_lane[lane];
        const v4 upper = top[c0] * (1.0f - fx) + top[c1] * fx, lower = top[width + c0] * (1.0f - fx) + top[width + c1] * fx;
        found[lane] = upper * (1.0f - fy) + lower * fy;
    }
    const auto component = [&](int k) -> v16 {
        const float* const f = (const float*)found + k;
        return v16{f[0], f[4], f[8], f[12], f[16], f[20], f[24], f[28], f[32], f[36], f[40], f[44], f[48], f[52], f[56], f[60]};
    };
    for (int k = 0; k < 3; ++k) seen[k] = light.intensity * component(k);
    return component(3) / (19.7392088f * max16(sin_polar, v16(1e-6f)) * (total > 0.0f ? total : 1.0f));
};
