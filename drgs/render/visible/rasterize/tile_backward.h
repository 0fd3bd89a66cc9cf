// Gradients of one 16x16 tile, front to back again: with S = sum over surfels of w (g . f), known from the forward pass,
// dL/dalpha_i = T_i (g . f_i) - (S - sum_{j <= i} w_j g . f_j) / (1 - alpha_i), so nothing but T and a running sum is kept.
// One row of `pair_gradients` is written per tile-surfel pair, at the pair's surfel-major place: no atomics, same bits each run.
//
// in   as tile_forward.h and what that wrote, plus gradient planes (CHANNELS, coverage, with DEPTH above 0 w z', above 1 median)
// out  pair_gradients (pair, 16 + CHANNELS): d/d(A: 9), d/d(center: 2), d/d(opacity), d/d(T_w.x, T_w.y, T_w.z), 0, d/d(features)
const int tiles_x = table.tiles_x, stride = table.stride, plane = table.plane;
const float depth_origin = table.depth_origin;
const int tile_x = tile % tiles_x, tile_y = tile / tiles_x;
const int* const list_surfel = table.list_surfel.data;
const int* const list_pair = table.list_pair.data;
const float* const surfel_rows = table.parameters.data;
const float* const feature_rows = table.features.data;
const int first = table.starts.data[tile], last = table.starts.data[tile + 1];
const v16 lane_x = block_x(), lane_y = block_y();
const float left = (float)(tile_x * 16), top = (float)(tile_y * 16);
const long corner = (long)(tile_y) * 16 * stride + tile_x * 16;
const float* const g_planes = gradients.data + corner;

// What pixels of this tile ask for, block by block.
v16 asked[CHANNELS + 1 + DEPTH][16], transmittance[16], behind[16];
i16 median[16];
for (int r = 0; r < 16; ++r) {
    transmittance[r] = v16(1.0f);
    behind[r] = v16(0.0f);  // S of all that is blended with weight w, which the median is not
    for (int k = 0; k < CHANNELS + 1 + DEPTH; ++k) {
        asked[k][r] = load_block(g_planes + (long)(k) * plane, stride, r);
        if (k < CHANNELS + 1 + (DEPTH > 0)) behind[r] += asked[k][r] * load_block(planes.data + (long)(k) * plane + corner, stride, r);
    }
    if (DEPTH > 1) median[r] = __builtin_bit_cast(i16, load_block((const float*)median_entry.data + corner, stride, r));
}
for (int entry = first; entry < last; ++entry) {
    float* const out = pair_gradients.data + (long)(list_pair[entry]) * (16 + CHANNELS);
    if (((entry - first) & 31) == 31) {
        i16 open = i16(0);
        for (int r = 0; r < 16; ++r) open |= transmittance[r] >= MIN_TRANSMITTANCE;
        if (!any(open)) {
            for (int rest = entry; rest < last; ++rest) {
                float* const zero = pair_gradients.data + (long)(list_pair[rest]) * (16 + CHANNELS);
                for (int k = 0; k < 16 + CHANNELS; ++k) zero[k] = 0.0f;
            }
            break;
        }
    }
    const long ahead = list_surfel[min_int(entry + AHEAD, last - 1)];
    prefetch_rows(surfel_rows + ahead * PARAMETERS, PARAMETERS);
    prefetch_rows(feature_rows + ahead * CHANNELS, CHANNELS);
    const float* const out_ahead = pair_gradients.data + (long)(list_pair[min_int(entry + AHEAD, last - 1)]) * (16 + CHANNELS);
    for (int k = 0; k < 16 + CHANNELS; k += 16) __builtin_prefetch(out_ahead + k, 1);
    const int surfel = list_surfel[entry];
    const float* const q = surfel_rows + (long)(surfel) * PARAMETERS;
    const float* const f = feature_rows + (long)(surfel) * CHANNELS;
    const int column_first = max_int(0, (int)(q[19] - left)) / 4, column_last = min_int(15, (int)(q[20] - left)) / 4;
    const int row_first = max_int(0, (int)(q[21] - top)) / 4, row_last = min_int(15, (int)(q[22] - top)) / 4;
    const v16 hx_lane = q[0] * lane_x + q[1] * lane_y, hy_lane = q[3] * lane_x + q[4] * lane_y, hz_lane = q[6] * lane_x + q[7] * lane_y;
    v16 d[16];  // A (9), filter centre (2), opacity, T_w (3), nothing
    v16 weight[16];
    int touched[16], touched_count = 0;
    for (int k = 0; k < 16; ++k) d[k] = v16(0.0f);
    for (int row = row_first; row <= row_last; ++row) for (int column = column_first; column <= column_last; ++column) {
        const int r = 4 * row + column;
        const float block_left = left + (float)(4 * column), block_top = top + (float)(4 * row);
        const v16 x = lane_x + (block_left - q[9]), y = lane_y + (block_top - q[10]);
        const v16 dx = lane_x + (block_left - q[11]), dy = lane_y + (block_top - q[12]);
        const v16 hx = hx_lane + (q[0] * (block_left - q[9]) + q[1] * (block_top - q[10]) + q[2]);
        const v16 hy = hy_lane + (q[3] * (block_left - q[9]) + q[4] * (block_top - q[10]) + q[5]);
        const v16 hz = hz_lane + (q[6] * (block_left - q[9]) + q[7] * (block_top - q[10]) + q[8]);
        const v16 h2 = hx * hx + hy * hy, hz2 = hz * hz;
        const v16 rho_screen = q[24] * (dx * dx + dy * dy);
        i16 front = hz > 0.0f;
        if (q[18] > 0.0f) front &= (q[15] - q[18]) * hz + q[16] * hx + q[17] * hy > 0.0f;
        const i16 inside = ((h2 <= q[14] * hz2) & front) | (rho_screen <= q[14]);
        const v16 T = transmittance[r];
        const i16 live = inside & (T >= MIN_TRANSMITTANCE);
        if (!any(live)) continue;
        const v16 rho_plane = select(front, h2 / (hz2 + 1e-30f), v16(1e30f));
        const v16 rho = min16(min16(rho_plane, rho_screen), v16(FAR));  // tile_forward.h says why
        const v16 e = exp_negative(0.5f * rho);
        const v16 raw = q[13] * e;
        const v16 alpha = min16(v16(MAX_ALPHA), raw);
        const v16 w = select(live, alpha * T, v16(0.0f));
        v16 gf = asked[CHANNELS][r];  // coverage: a feature that is 1
#pragma unroll
        for (int k = 0; k < CHANNELS; ++k) gf += asked[k][r] * f[k];
        touched[touched_count] = r;
        weight[touched_count++] = w;
        v16 dhx = v16(0.0f), dhy = v16(0.0f), dhz = v16(0.0f);
        if (DEPTH > 0) {
            const v16 radius = sqrt16(h2);
            const v16 limit = radius * (1.0f / DEPTH_CUTOFF);
            const v16 abs_hz = abs16(hz);
            const v16 inverse_reach = 1.0f / (max16(abs_hz, limit) + 1e-30f);
            const v16 u = hx * inverse_reach, v = hy * inverse_reach;
            const v16 z = q[15] + q[16] * u + q[17] * v;
            const v16 z_relative = z - depth_origin;
            const v16 g1 = asked[CHANNELS + 1][r];
            gf += g1 * z_relative;
            v16 dz = w * g1;
            if (DEPTH > 1) {
                const i16 is_median = live & (median[r] == i16(entry));
                dz += select(is_median, asked[CHANNELS + DEPTH][r], v16(0.0f));
            }
            d[14] += dz;
            d[12] += dz * u;
            d[13] += dz * v;
            const v16 du = dz * q[16], dv = dz * q[17];
            const v16 dreach = -(du * u + dv * v) * inverse_reach;
            const i16 limited = limit > abs_hz;
            const v16 dh = select(limited, dreach * (1.0f / DEPTH_CUTOFF) / (radius + 1e-30f), v16(0.0f));
            dhx += du * inverse_reach + dh * hx;
            dhy += dv * inverse_reach + dh * hy;
            dhz += select(limited, v16(0.0f), select(hz < 0.0f, -dreach, dreach));
        }
        behind[r] -= w * gf;
        const v16 dalpha = select(live & (raw < MAX_ALPHA), T * gf - behind[r] / (1.0f - alpha), v16(0.0f));
        d[11] += dalpha * e;
        const v16 drho = -0.5f * alpha * dalpha;
        const i16 plane_wins = rho_plane <= rho_screen;
        const v16 drho_plane = select(plane_wins, drho, v16(0.0f));
        const v16 drho_screen = select(plane_wins, v16(0.0f), drho);
        d[9] -= 2.0f * q[24] * drho_screen * dx;
        d[10] -= 2.0f * q[24] * drho_screen * dy;
        const v16 inverse_hz2 = 1.0f / (hz2 + 1e-30f);
        const v16 scale = 2.0f * drho_plane * inverse_hz2;
        dhx += scale * hx;
        dhy += scale * hy;
        dhz -= select(plane_wins, scale * rho_plane * hz, v16(0.0f));
        d[0] += dhx * x; d[1] += dhx * y; d[2] += dhx;
        d[3] += dhy * x; d[4] += dhy * y; d[5] += dhy;
        d[6] += dhz * x; d[7] += dhz * y; d[8] += dhz;
        transmittance[r] = T - w;
    }
    if (touched_count == 0) {
        for (int k = 0; k < 16 + CHANNELS; ++k) out[k] = 0.0f;
        continue;
    }
    store16(out, sums16(d));
    // Features apart from geometry, so that neither loop runs out of registers.
    for (int block = 0; block < CHANNELS; block += 16) {
        v16 df[16];
        for (int k = 0; k < 16; ++k) df[k] = v16(0.0f);
        for (int k = 0; k < 16 && block + k < CHANNELS; ++k) {
            v16 sum = v16(0.0f);
            for (int n = 0; n < touched_count; ++n) sum += asked[block + k][touched[n]] * weight[n];
            df[k] = sum;
        }
        const v16 sums = sums16(df);
        for (int k = 0; k < 16 && block + k < CHANNELS; ++k) out[16 + block + k] = sums[k];
    }
}
