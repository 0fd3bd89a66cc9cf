// filter_level of denoise.py for 16 pixels of a row at once, CPU only. Body of a Warp native function; denoise.py puts simd_vector.h and
// the constants before it. A test keeps both equal. The maps lie as in smooth_variance.h.
//
// in   at, guides (8 planes: coverage, footprint, position, normal), source (8: diffuse, specular, variance), smooth (2)
// out  target (8: diffuse, specular, variance)
const long plane = (long)height * pitch;
const float* const guide = guides.data;
const float* const from = source.data;
const float* const soft = smooth.data;
const i16 covered = load16(guide + at) > 0.0f;
const v16 x = load16(guide + 2 * plane + at), y = load16(guide + 3 * plane + at), z = load16(guide + 4 * plane + at);
const v16 nx = load16(guide + 5 * plane + at), ny = load16(guide + 6 * plane + at), nz = load16(guide + 7 * plane + at);
const auto luminance = [&](const float* p) { return LUMINANCE_RED * load16(p) + LUMINANCE_GREEN * load16(p + plane) + LUMINANCE_BLUE * load16(p + 2 * plane); };
const v16 y_d = luminance(from + at), y_s = luminance(from + 3 * plane + at);
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
        const v16 d0 = load16(f), d1 = load16(f + plane), d2 = load16(f + 2 * plane);
        const v16 s0 = load16(f + 3 * plane), s1 = load16(f + 4 * plane), s2 = load16(f + 5 * plane);
        const v16 off_d = abs16(LUMINANCE_RED * d0 + LUMINANCE_GREEN * d1 + LUMINANCE_BLUE * d2 - y_d) * inverse_sqrt_roughly(both_d);
        const v16 off_s = abs16(LUMINANCE_RED * s0 + LUMINANCE_GREEN * s1 + LUMINANCE_BLUE * s2 - y_s) * inverse_sqrt_roughly(both_s);
        const v16 w_d = weight(shared, off_plane + off_d), w_s = weight(shared, off_plane + off_s);
        sum[0] += w_d * d0;
        sum[1] += w_d * d1;
        sum[2] += w_d * d2;
        sum[3] += w_s * s0;
        sum[4] += w_s * s1;
        sum[5] += w_s * s2;
        sum[6] += w_d * w_d * load16(f + 6 * plane);
        sum[7] += w_s * w_s * load16(f + 7 * plane);
        weights_d += w_d;
        weights_s += w_s;
    }
}
const v16 inverse_d = 1.0f / max16(weights_d, v16(1e-20f)), inverse_s = 1.0f / max16(weights_s, v16(1e-20f));
for (int k = 0; k < 8; ++k) {
    const v16 inverse = k < 3 || k == 6 ? inverse_d : inverse_s;
    const v16 mean = sum[k] * inverse * (k < 6 ? v16(1.0f) : inverse);
    store16(target.data + k * plane + at, select(covered, mean, v16(0.0f)));
}
