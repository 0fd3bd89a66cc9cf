// smooth_variance of svgf.py for 16 pixels of a row at once, CPU only. Body of a Warp native function; svgf.py puts simd_vector.h, planes.h
// before it. A test keeps both equal.
//
// Maps are planes of `height` rows of `pitch` pixels with at least 2 * step empty (coverage 0) pixels at both ends of each row.
// in   at (first pixel of the group), coverage, variance (2 planes)
// out  smooth (2 planes)
const float* const cover = coverage.data;
const long plane = planes_apart(height, pitch);
const int y = at / pitch;
v16 total[2] = {v16(0.0f), v16(0.0f)}, weights(0.0f);
for (int dy = -2; dy <= 2; ++dy) {
    const int row = y + dy * step;
    if (row < 0 || row >= height) continue;
    for (int dx = -2; dx <= 2; ++dx) {
        const long q = at + (long)dy * step * pitch + dx * step;
        const float w = (float)((3 - (dx < 0 ? -dx : dx)) * (3 - (dy < 0 ? -dy : dy)));
        total[0] += w * load16(variance.data + q);  // 0 where nothing is covered
        total[1] += w * load16(variance.data + plane + q);
        weights += select(load16(cover + q) > 0.0f, v16(w), v16(0.0f));
    }
}
const v16 inverse = 1.0f / max16(weights, v16(1e-12f));
store16(smooth.data + at, total[0] * inverse);
store16(smooth.data + plane + at, total[1] * inverse);
