// filter_level of svgf.py for 16 pixels of a row at once, CPU only. Body of a Warp native function; svgf.py puts simd_vector.h, planes.h and
// the constants before it. A test keeps both equal. The maps lie as in smooth_variance.h.
//
// in   at, guides (8 planes: coverage, footprint, position, normal), source (10: diffuse, specular, luminance of both, variance), smooth (2)
// out  target (10, as source)
const long plane = planes_apart(height, pitch);
const float* const guide = guides.data;
const float* const from = source.data;
const float* const soft = smooth.data;
const i16 covered = load16(guide + at) > 0.0f;
const v16 x = load16(guide + 2 * plane + at), y = load16(guide + 3 * plane + at), z = load16(guide + 4 * plane + at);
const v16 nx = load16(guide + 5 * plane + at), ny = load16(guide + 6 * plane + at), nz = load16(guide + 7 * plane + at);
const v16 y_d = load16(from + 6 * plane + at), y_s = load16(from + 7 * plane + at);
// The square of sigma_luminance standard deviations, and 1e-12.
const float variance_scale = sigma_luminance * sigma_luminance, neighbour_scale = variance_scale * neighbour_variance;
const v16 scaled_d = variance_scale * load16(soft + at) + 1e-12f, scaled_s = variance_scale * load16(soft + plane + at) + 1e-12f;
const v16 plane_scale = 1.0f / max16(sigma_plane * (float)step * load16(guide + plane + at), v16(1e-12f));
const auto weight = [&](v16 most, v16 off) -> v16 {
    const v16 found = most * exp_negative_roughly(min16(off, v16(28.0f)));
    return select(found > 1e-12f, found, v16(0.0f));
};
v16 sum[8], weights_d(0.0f), weights_s(0.0f);
for (int k = 0; k < 8; ++k) sum[k] = v16(0.0f);
const float hat[3] = {0.375f, 0.25f, 0.0625f};
const int row_here = at / pitch;
for (int dy = -2; dy <= 2; ++dy) {
    const int row = row_here + dy * step;
    if (row < 0 || row >= height) continue;
    for (int dx = -2; dx <= 2; ++dx) {
        const long q = at + (long)dy * step * pitch + dx * step;
        const float *g = guide + q, *f = from + q, *v = soft + q;
        // Else the compiler counts sixteen pointers up, in memory.
        asm("" : "+r"(g), "+r"(f), "+r"(v));
        const v16 there = load16(g);
        if (!any(there > 0.0f)) continue;
        v16 alike = max16(nx * load16(g + 5 * plane) + ny * load16(g + 6 * plane) + nz * load16(g + 7 * plane), v16(0.0f));
        // Weights below 1e-12 are none: numbers too small for a float's exponent take the processor many times as long.
        alike = select(alike > 0.65f, alike, v16(0.0f));
        for (int k = 1; k < NORMAL_POWER; k *= 2) alike *= alike;
        // Differences first: far from the origin products with a normal have lost the footprint's digits.
        const v16 off = nx * (load16(g + 2 * plane) - x) + ny * (load16(g + 3 * plane) - y) + nz * (load16(g + 4 * plane) - z);
        const v16 off_plane = abs16(off) * plane_scale;
        const v16 shared = (hat[dx < 0 ? -dx : dx] * hat[dy < 0 ? -dy : dy]) * alike * there;
        const v16 both_d = scaled_d + neighbour_scale * load16(v), both_s = scaled_s + neighbour_scale * load16(v + plane);
        const v16 off_d = abs16(load16(f + 6 * plane) - y_d) * inverse_sqrt_roughly(both_d);
        const v16 off_s = abs16(load16(f + 7 * plane) - y_s) * inverse_sqrt_roughly(both_s);
        const v16 w_d = weight(shared, off_plane + off_d), w_s = weight(shared, off_plane + off_s);
        for (int k = 0; k < 3; ++k) {
            sum[k] += w_d * load16(f + k * plane);
            sum[3 + k] += w_s * load16(f + (3 + k) * plane);
        }
        sum[6] += w_d * w_d * load16(f + 8 * plane);
        sum[7] += w_s * w_s * load16(f + 9 * plane);
        weights_d += w_d;
        weights_s += w_s;
    }
}
const v16 inverse_d = 1.0f / max16(weights_d, v16(1e-20f)), inverse_s = 1.0f / max16(weights_s, v16(1e-20f));
const auto put = [&](int k, v16 mean) { store16(target.data + k * plane + at, select(covered, mean, v16(0.0f))); };
for (int k = 0; k < 3; ++k) {
    sum[k] *= inverse_d;
    sum[3 + k] *= inverse_s;
    put(k, sum[k]);
    put(3 + k, sum[3 + k]);
}
for (int k = 0; k < 2; ++k) put(6 + k, LUMINANCE_RED * sum[3 * k] + LUMINANCE_GREEN * sum[3 * k + 1] + LUMINANCE_BLUE * sum[3 * k + 2]);
put(8, sum[6] * inverse_d * inverse_d);
put(9, sum[7] * inverse_s * inverse_s);
