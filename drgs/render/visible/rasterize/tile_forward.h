// Blends the surfels of one 16x16 tile, front to back, 16 pixels of a block of 4x4 at a time: most surfels are a few pixels wide,
// and boxes of 4x4 that they touch are two thirds of the rows of 16 that they touch.
// Body of a Warp native function; tile_kernels.py puts constants (CHANNELS, DEPTH, PARAMETERS, ...), simd_vector.h and tile_blocks.h before it.
//
// in   tile, table (TileTable of tile_kernels.py)
// out  planes: CHANNELS features, coverage, with DEPTH above 0 sum w z' (z' = z - depth_origin), above 1 the median depth; all (plane)
//      median_entry (plane), with DEPTH above 1: list position behind the median depth, -1 where none
const int tiles_x = table.tiles_x, stride = table.stride, plane = table.plane;
const float depth_origin = table.depth_origin;
const int tile_x = tile % tiles_x, tile_y = tile / tiles_x;
const int* const list_surfel = table.list_surfel.data;
const float* const surfel_rows = table.parameters.data;
const float* const feature_rows = table.features.data;
float* const out = planes.data;
const int first = table.starts.data[tile], last = table.starts.data[tile + 1];
const v16 lane_x = block_x(), lane_y = block_y();
const float left = (float)(tile_x * 16), top = (float)((table.first_row + tile_y) * 16);

v16 sums[CHANNELS + 1 + DEPTH][16];
v16 transmittance[16];
i16 median[16];
for (int k = 0; k < CHANNELS + 1 + DEPTH; ++k)
    for (int r = 0; r < 16; ++r) sums[k][r] = v16(0.0f);
for (int r = 0; r < 16; ++r) { transmittance[r] = v16(1.0f); median[r] = i16(-1); }

for (int entry = first; entry < last; ++entry) {
    if (((entry - first) & 31) == 31) {  // every pixel opaque: nothing behind can be seen
        i16 open = i16(0);
        for (int r = 0; r < 16; ++r) open |= transmittance[r] >= MIN_TRANSMITTANCE;
        if (!any(open)) break;
    }
    const long ahead = list_surfel[min_int(entry + AHEAD, last - 1)];
    prefetch_rows(surfel_rows + ahead * PARAMETERS, PARAMETERS);
    prefetch_rows(feature_rows + ahead * CHANNELS, CHANNELS);
    const int surfel = list_surfel[entry];
    const float* const q = surfel_rows + (long)(surfel) * PARAMETERS;
    const float* const f = feature_rows + (long)(surfel) * CHANNELS;
    const int column_first = max_int(0, (int)(q[19] - left)) / 4, column_last = min_int(15, (int)(q[20] - left)) / 4;
    const int row_first = max_int(0, (int)(q[21] - top)) / 4, row_last = min_int(15, (int)(q[22] - top)) / 4;
    const v16 hx_lane = q[0] * lane_x + q[1] * lane_y, hy_lane = q[3] * lane_x + q[4] * lane_y, hz_lane = q[6] * lane_x + q[7] * lane_y;
    for (int row = row_first; row <= row_last; ++row) for (int column = column_first; column <= column_last; ++column) {
        const int r = 4 * row + column;
        const float block_left = left + (float)(4 * column), block_top = top + (float)(4 * row);
        const float x = block_left - q[9], y = block_top - q[10];
        const v16 dx = lane_x + (block_left - q[11]), dy = lane_y + (block_top - q[12]);
        const v16 hx = hx_lane + (q[0] * x + q[1] * y + q[2]);
        const v16 hy = hy_lane + (q[3] * x + q[4] * y + q[5]);
        const v16 hz = hz_lane + (q[6] * x + q[7] * y + q[8]);
        const v16 h2 = hx * hx + hy * hy, hz2 = hz * hz;
        // rho <= rho_max in the plane's branch, without dividing first
        const v16 rho_screen = q[24] * (dx * dx + dy * dy);
        i16 front = hz > 0.0f;
        if (q[18] > 0.0f) front &= (q[15] - q[18]) * hz + q[16] * hx + q[17] * hy > 0.0f;  // nearer than the near plane
        const i16 inside = ((h2 <= q[14] * hz2) & front) | (rho_screen <= q[14]);
        v16 T = transmittance[r];
        const i16 live = inside & (T >= MIN_TRANSMITTANCE);
        if (!any(live)) continue;
        const v16 rho_plane = select(front, h2 / (hz2 + 1e-30f), v16(1e30f));
        // Farther off no pixel is live; numbers too small for a float's exponent would take the processor many times as long.
        const v16 rho = min16(min16(rho_plane, rho_screen), v16(FAR));
        const v16 alpha = min16(v16(MAX_ALPHA), q[13] * exp_negative(0.5f * rho));
        const v16 w = select(live, alpha * T, v16(0.0f));
#pragma unroll
        for (int k = 0; k < CHANNELS; ++k) sums[k][r] += w * f[k];
        sums[CHANNELS][r] += w;
        if (DEPTH > 0) {
            const v16 reach = max16(abs16(hz), sqrt16(h2) * (1.0f / DEPTH_CUTOFF)) + 1e-30f;
            const v16 z = q[15] + (q[16] * hx + q[17] * hy) / reach;
            sums[CHANNELS + 1][r] += w * (z - depth_origin);
            if (DEPTH > 1) {
                const i16 is_median = live & (T > 0.5f);
                sums[CHANNELS + DEPTH][r] = select(is_median, z, sums[CHANNELS + DEPTH][r]);
                median[r] = is_median ? i16(entry) : median[r];
            }
        }
        transmittance[r] = T - w;
    }
}
const long corner = (long)(tile_y) * 16 * stride + tile_x * 16;
for (int k = 0; k < CHANNELS + 1 + DEPTH; ++k)
    for (int r = 0; r < 16; ++r) store_block(out + (long)(k) * plane + corner, stride, r, sums[k][r]);
if (DEPTH > 1)
    for (int r = 0; r < 16; ++r) store_block((float*)median_entry.data + corner, stride, r, __builtin_bit_cast(v16, median[r]));
