// start_rays for 16 rays at once, CPU only. Body of a Warp native function; shade.py prepends the rasteriser's tile_vector.h and
// `constexpr float MIN_ROUGHNESS`. The Warp kernel start_rays in shade.py says the same ray by ray; a test keeps both equal.
// Lanes never look at each other, so a ray's result does not depend on its group.
//
// in   base (first ray of the group in the batch), ray_count (of the batch), first (the batch's first ray among all),
//      points, starts, surface_normals, horizon (of each point), light, samples, keep_dark
// out  origin, direction, cosine_weight, specular, radiance of rays base .. base + 15
typedef unsigned u16 __attribute__((ext_vector_type(16)));
const float PI = 3.14159265358979f;
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

// 1. Gather the points of the group's rays.
const int count = samples.cosine + samples.ggx + samples.environment;
const int lanes = min_int(16, ray_count - base);
const float* const normals = (const float*)points.normal.data;
const float* const outgoing = (const float*)points.wo.data;
const float* const albedos = (const float*)points.albedo.data;
const float* const triangles = (const float*)surface_normals.data;
alignas(64) float gathered[15][16];
alignas(64) unsigned pixel_lane[16], index_lane[16], strategy_lane[16];
int point_lane[16];
for (int lane = 0; lane < 16; ++lane) {
    const int ray = first + base + min_int(lane, lanes - 1), point = ray / count, slot = ray - point * count;
    const float metal = points.metallic.data[point], rough = points.roughness.data[point];
    int n_cosine = samples.cosine, n_ggx = samples.ggx, n_environment = samples.environment;
    if (samples.by_material != 0) {  // split_at of sample_rays.py
        const float a0 = albedos[3 * point], a1 = albedos[3 * point + 1], a2 = albedos[3 * point + 2];
        const float largest = a0 > a1 ? (a0 > a2 ? a0 : a2) : (a1 > a2 ? a1 : a2);
        const float diffuse = (1.0f - metal) * largest, mirror_like = 0.04f * (1.0f - metal) + metal * largest;
        const float sum = diffuse + mirror_like, share = diffuse / (sum > 1e-6f ? sum : 1e-6f);
        n_cosine = min_int((int)((float)samples.cosine * share + 0.5f), count - 1);
        const int rest = count - n_cosine;
        n_ggx = rest;
        if (samples.environment != 0) {
            const float even = (float)samples.ggx / (float)(samples.ggx + samples.environment);
            const float clamped = 1.0f - 4.0f * rough;
            const float mirror = (1.0f - share) * (clamped > 0.0f ? (clamped < 1.0f ? clamped : 1.0f) : 0.0f);
            n_ggx = min_int(max_int((int)((float)rest * (even + (1.0f - even) * mirror) + 0.5f), 1), rest);
        }
        n_environment = rest - n_ggx;
    }
    const int strategy = slot < n_cosine ? 0 : (slot < n_cosine + n_ggx ? 1 : 2);
    const int own = strategy == 0 ? n_cosine : (strategy == 1 ? n_ggx : n_environment);
    const int before = strategy == 0 ? 0 : (strategy == 1 ? n_cosine : n_cosine + n_ggx);
    point_lane[lane] = point;
    strategy_lane[lane] = (unsigned)strategy;
    index_lane[lane] = (unsigned)((samples.round + (points.round.shape[0] > 0 ? points.round.data[point] : 0)) * own + slot - before);
    pixel_lane[lane] = (unsigned)points.pixel.data[point];
    for (int k = 0; k < 3; ++k) {
        gathered[k][lane] = normals[3 * point + k];
        gathered[3 + k][lane] = outgoing[3 * point + k];
        gathered[6 + k][lane] = triangles[3 * point + k];
    }
    gathered[9][lane] = rough;
    gathered[10][lane] = metal;
    gathered[11][lane] = (float)n_cosine;
    gathered[12][lane] = (float)n_ggx;
    gathered[13][lane] = (float)n_environment;
    gathered[14][lane] = horizon.shape[0] > 0 ? horizon.data[point] : 2.0f;
}
const v16 nx = load16(gathered[0]), ny = load16(gathered[1]), nz = load16(gathered[2]);
const v16 ox = load16(gathered[3]), oy = load16(gathered[4]), oz = load16(gathered[5]);
const v16 metallic = load16(gathered[10]);
const v16 roughness = max16(load16(gathered[9]), v16(MIN_ROUGHNESS)), alpha = roughness * roughness, alpha2 = alpha * alpha;
const u16 strategy = *(const u16*)strategy_lane, index = *(const u16*)index_lane;

// 2. Two numbers a ray.
const u16 seed = hash_combine(hash_combine(u16(samples.seed), *(const u16*)pixel_lane), strategy);
u16 second = u16(0u), row = u16(1u), bits = index;
while (__builtin_reduce_or(bits) != 0u) {
    second = (bits & 1u) != 0u ? second ^ row : second;
    row = row ^ (row << 1);
    bits = bits >> 1;
}
const v16 u0 = to_float(reverse_bits(scramble_reversed(index, hash32(seed))) >> 8) * 5.9604645e-08f;
const v16 u1 = to_float(reverse_bits(scramble_reversed(second, hash32(seed ^ 0x68BC21EBu))) >> 8) * 5.9604645e-08f;

// 3. Directions: cosine and GGX in the normal's frame for all lanes, the environment table for those that ask for it.
const v16 sign = nz >= 0.0f ? v16(1.0f) : v16(-1.0f);
const v16 frame_a = -1.0f / (sign + nz);
const v16 tx = 1.0f + sign * nx * nx * frame_a, ty = sign * nx * ny * frame_a, tz = -sign * nx;
const v16 bx = ny * tz - nz * ty, by = nz * tx - nx * tz, bz = nx * ty - ny * tx;
const v16 n_dot_v = nx * ox + ny * oy + nz * oz;
const v16 local_x = tx * ox + ty * oy + tz * oz, local_y = bx * ox + by * oy + bz * oz;
v16 sine, cosine;
sincos_turns(u1, sine, cosine);
const v16 sin2_v = max16(1.0f - n_dot_v * n_dot_v, v16(0.0f));
const v16 reach = 1.0f + sqrt16(sin2_v), reach2 = reach * reach;
const v16 bound = (1.0f - alpha2) * reach2 / (reach2 + alpha2 * n_dot_v * n_dot_v);
const v16 stretch = sqrt16(alpha2 * sin2_v + n_dot_v * n_dot_v);
const v16 scale = 1.0f / sqrt16(max16(alpha2 * (local_x * local_x + local_y * local_y) + n_dot_v * n_dot_v, v16(1e-30f)));
const v16 sx = alpha * local_x * scale, sy = alpha * local_y * scale, sz = n_dot_v * scale;
const v16 cap_z = 1.0f - u0 * (1.0f + bound * sz);
const v16 cap_r = sqrt16(max16(1.0f - cap_z * cap_z, v16(0.0f)));
v16 mx = alpha * (cap_r * cosine + sx), my = alpha * (cap_r * sine + sy), mz = cap_z + sz;
const v16 m_scale = 1.0f / sqrt16(max16(mx * mx + my * my + mz * mz, v16(1e-30f)));
mx *= m_scale; my *= m_scale; mz *= m_scale;
const v16 twice = 2.0f * (local_x * mx + local_y * my + n_dot_v * mz);
const i16 is_cosine = strategy == 0u, is_environment = strategy == 2u;
const v16 disc = sqrt16(u0);
const v16 lx = select(is_cosine, disc * cosine, twice * mx - local_x);
const v16 ly = select(is_cosine, disc * sine, twice * my - local_y);
const v16 lz = select(is_cosine, sqrt16(max16(1.0f - u0, v16(0.0f))), twice * mz - n_dot_v);
v16 dx = lx * tx + ly * bx + lz * nx, dy = lx * ty + ly * by + lz * ny, dz = lx * tz + ly * bz + lz * nz;
const int height = light.height, width = light.width;
const float* const nodes = light.nodes.data;
const float* const sums = light.column_sums.data;
const float* const rows = light.row_sums.data;
const float total = rows[height + 1];
if (any(is_environment)) {
    alignas(64) float azimuth_lane[16], polar_lane[16], first_number[16], second_number[16];
    store16(first_number, u0);
    store16(second_number, u1);
    for (int lane = 0; lane < 16; ++lane) {
        azimuth_lane[lane] = polar_lane[lane] = 0.0f;
        if (strategy_lane[lane] != 2u) continue;
        const auto linear_place = [](float u, float a, float b) -> float {
            u = u < 0.0f ? 0.0f : (u > 1.0f ? 1.0f : u);
            const float square = a * a + u * (b * b - a * a), root = a + __builtin_sqrtf(square > 0.0f ? square : 0.0f);
            return u * (a + b) / (root > 1e-37f ? root : 1e-37f);
        };
        float target = first_number[lane] * total;
        int low = 0, high = height + 1;
        while (high - low > 1) {
            const int middle = (low + high) >> 1;
            if (rows[middle] <= target) low = middle; else high = middle;
        }
        const int r = low;
        float mass = rows[r + 1] - rows[r];
        const float* const upper = sums + (long)r * (width + 1);
        const float* const lower = upper + (width + 1);
        const float t = linear_place((target - rows[r]) / (mass > 1e-37f ? mass : 1e-37f), upper[width], lower[width]);
        const float y = r == 0 ? 0.5f * t : (r == height ? (float)r - 0.5f + 0.5f * t : (float)r - 0.5f + t);
        target = second_number[lane] * (upper[width] * (1.0f - t) + lower[width] * t);
        low = 0;
        high = width;
        while (high - low > 1) {
            const int middle = (low + high) >> 1;
            if (upper[middle] * (1.0f - t) + lower[middle] * t <= target) low = middle; else high = middle;
        }
        const float at = upper[low] * (1.0f - t) + lower[low] * t;
        mass = upper[low + 1] * (1.0f - t) + lower[low + 1] * t - at;
        const int next = low + 1 == width ? 0 : low + 1;
        const float* const top = nodes + (long)r * width;
        const float a = top[low] * (1.0f - t) + top[width + low] * t, b = top[next] * (1.0f - t) + top[width + next] * t;
        azimuth_lane[lane] = 0.5f - ((float)low + 0.5f + linear_place((target - at) / (mass > 1e-37f ? mass : 1e-37f), a, b)) / (float)width;
        polar_lane[lane] = 0.5f * y / (float)height;
    }
    v16 sin_azimuth, cos_azimuth, sin_polar, cos_polar;
    sincos_turns(load16(azimuth_lane), sin_azimuth, cos_azimuth);
    sincos_turns(load16(polar_lane), sin_polar, cos_polar);
    const v16 ex = cos_azimuth * sin_polar, ey = sin_azimuth * sin_polar;
    dx = select(is_environment, light.cos_rotation * ex - light.sin_rotation * ey, dx);
    dy = select(is_environment, light.sin_rotation * ex + light.cos_rotation * ey, dy);
    dz = select(is_environment, cos_polar, dz);
}
const v16 d_scale = 1.0f / sqrt16(max16(dx * dx + dy * dy + dz * dz, v16(1e-30f)));
dx *= d_scale; dy *= d_scale; dz *= d_scale;
const v16 n_dot_l = nx * dx + ny * dy + nz * dz;
const v16 above = load16(gathered[6]) * dx + load16(gathered[7]) * dy + load16(gathered[8]) * dz;
i16 live = (n_dot_v > 0.0f) & (n_dot_l > 0.0f) & (above > 0.0f);

// 4. The environment there: radiance and density, both bilinear.
const v16 turned_x = light.cos_rotation * dx + light.sin_rotation * dy, turned_y = light.cos_rotation * dy - light.sin_rotation * dx;
const v16 sin_polar = sqrt16(dx * dx + dy * dy);
const v16 u = 0.5f - atan2_turns(turned_y, turned_x), v = 2.0f * atan2_turns(sin_polar, dz);
const v16 x = u * (float)width - 0.5f, x0 = floor16(x), fx = x - x0;
const v16 y = min16(max16(v * (float)height - 0.5f, v16(0.0f)), v16((float)(height - 1)));
const v16 y0 = min16(floor16(y), v16((float)max_int(height - 2, 0))), fy = y - y0;
const v16 node_y = v * (float)height + 0.5f, node_row = min16(max16(floor16(node_y), v16(0.0f)), v16((float)height));
v16 node_t = node_y - node_row;
node_t = select(node_row == 0.0f, 2.0f * (node_y - 0.5f), node_t);
node_t = select(node_row == (float)height, 2.0f * (node_y - node_row), node_t);
node_t = min16(max16(node_t, v16(0.0f)), v16(1.0f));
alignas(64) int column_lane[16], row_lane[16], node_lane[16], live_lane[16];
*(i16*)column_lane = __builtin_convertvector(x0, i16);
*(i16*)row_lane = __builtin_convertvector(y0, i16);
*(i16*)node_lane = __builtin_convertvector(node_row, i16);
*(i16*)live_lane = live;
const float* const texels = (const float*)light.radiance.data;
alignas(64) float corner[16][16];
for (int lane = 0; lane < 16; ++lane) {
    if (live_lane[lane] == 0) {
        for (int k = 0; k < 16; ++k) corner[k][lane] = 0.0f;
        continue;
    }
    int c0 = column_lane[lane];
    c0 = c0 < 0 ? c0 + width : (c0 >= width ? c0 - width : c0);
    const int c1 = c0 + 1 == width ? 0 : c0 + 1, r0 = row_lane[lane], r1 = min_int(r0 + 1, height - 1);
    for (int k = 0; k < 3; ++k) {
        corner[k][lane] = texels[3 * (r0 * width + c0) + k];
        corner[3 + k][lane] = texels[3 * (r0 * width + c1) + k];
        corner[6 + k][lane] = texels[3 * (r1 * width + c0) + k];
        corner[9 + k][lane] = texels[3 * (r1 * width + c1) + k];
    }
    const float* const top = nodes + (long)node_lane[lane] * width;
    corner[12][lane] = top[c0];
    corner[13][lane] = top[c1];
    corner[14][lane] = top[width + c0];
    corner[15][lane] = top[width + c1];
}
v16 seen[3];
for (int k = 0; k < 3; ++k) {
    const v16 top = load16(corner[k]) * (1.0f - fx) + load16(corner[3 + k]) * fx;
    const v16 bottom = load16(corner[6 + k]) * (1.0f - fx) + load16(corner[9 + k]) * fx;
    seen[k] = light.intensity * (top * (1.0f - fy) + bottom * fy);
}
const v16 upper = load16(corner[12]) * (1.0f - fx) + load16(corner[13]) * fx;
const v16 lower = load16(corner[14]) * (1.0f - fx) + load16(corner[15]) * fx;
const v16 table_pdf = (upper * (1.0f - node_t) + lower * node_t) / (19.7392088f * max16(sin_polar, v16(1e-6f)) * (total > 0.0f ? total : 1.0f));
if (keep_dark == 0) live &= max16(seen[0], max16(seen[1], seen[2])) > 0.0f;

// 5. Weight and specular reflection.
v16 hx = dx + ox, hy = dy + oy, hz = dz + oz;
const v16 h_scale = 1.0f / sqrt16(max16(hx * hx + hy * hy + hz * hz, v16(1e-30f)));
hx *= h_scale; hy *= h_scale; hz *= h_scale;
const v16 n_dot_h = nx * hx + ny * hy + nz * hz;
const v16 cross_x = ny * hz - nz * hy, cross_y = nz * hx - nx * hz, cross_z = nx * hy - ny * hx;
const v16 denominator = cross_x * cross_x + cross_y * cross_y + cross_z * cross_z + n_dot_h * n_dot_h * alpha2;
const v16 ggx = alpha2 / max16(PI * denominator * denominator, v16(1e-30f));
const v16 ggx_pdf = select(n_dot_h > 0.0f, ggx / (2.0f * (bound * n_dot_v + stretch)), v16(0.0f));
const v16 density = load16(gathered[11]) * n_dot_l * (1.0f / PI) + load16(gathered[12]) * ggx_pdf + load16(gathered[13]) * table_pdf;
live &= density > 0.0f;
const v16 w = select(live, n_dot_l / max16(density, v16(1e-37f)), v16(0.0f));
const v16 nl = max16(n_dot_l, v16(1e-6f)), nv = max16(n_dot_v, v16(1e-6f));
const v16 lambda = nl * sqrt16(nv * nv * (1.0f - alpha2) + alpha2) + nv * sqrt16(nl * nl * (1.0f - alpha2) + alpha2);
const v16 dv = w * ggx * 0.5f / max16(lambda, v16(1e-12f));
const v16 c = 1.0f - min16(max16(hx * ox + hy * oy + hz * oz, v16(0.0f)), v16(1.0f));
const v16 c2 = c * c, c5 = c2 * c2 * c;
alignas(64) float result[14][16];
store16(result[0], select(live, dx, v16(0.57735027f)));
store16(result[1], select(live, dy, v16(0.57735027f)));
store16(result[2], select(live, dz, v16(0.57735027f)));
store16(result[3], w);
store16(result[4], dv * (1.0f - c5));
store16(result[5], dv * c5);
for (int k = 0; k < 3; ++k) store16(result[6 + k], select(live, seen[k], v16(0.0f)));
*(i16*)live_lane = live;
alignas(64) int traced_lane[16];
*(i16*)traced_lane = above <= load16(gathered[14]);
const float* const from = (const float*)starts.data;
float* const origin_out = (float*)origin.data;
float* const direction_out = (float*)direction.data;
float* const specular_out = (float*)specular.data;
float* const radiance_out = (float*)radiance.data;
for (int lane = 0; lane < lanes; ++lane) {
    const int ray = base + lane, point = point_lane[lane];
    const float metal = gathered[10][lane];
    cosine_weight.data[ray] = result[3][lane];
    for (int k = 0; k < 3; ++k) {
        // Rays that are void or meet nothing for certain leave from far outside, away from the mesh.
        const float outside = result[k][lane] < 0.0f ? -1.0e15f : 1.0e15f;
        origin_out[3 * ray + k] = live_lane[lane] != 0 && traced_lane[lane] != 0 ? from[3 * point + k] : outside;
        direction_out[3 * ray + k] = result[k][lane];
        const float f0 = 0.04f * (1.0f - metal) + albedos[3 * point + k] * metal;
        specular_out[3 * ray + k] = result[4][lane] * f0 + result[5][lane];
        radiance_out[3 * ray + k] = result[6 + k][lane];
    }
}
