// The gradient of a picture's SSIM, summed over its pixels, by the image: the slopes of ssim_means.h under the same window, one row's segment.
// Body of a Warp native function, CPU only; similarity.py puts constants and simd_vector.h before it. Layouts as in ssim_means.h.
//
// in   index (segment of a row), height, width, pitch, image, photo, slopes (3 planes)
// out  gradient (one plane)
const float window[6] = {WINDOW_0, WINDOW_1, WINDOW_2, WINDOW_3, WINDOW_4, WINDOW_5};
const int segments = (width + SEGMENT - 1) / SEGMENT;
const int y = index / segments, left = index % segments * SEGMENT;
const int groups = min_int(SEGMENT, width - left + 15) / 16;
const long plane = (long)height * pitch;
float lines[3][SEGMENT + 32];
for (int k = 0; k < groups + 2; ++k) {
    v16 sums[3] = {v16(0.0f), v16(0.0f), v16(0.0f)};
    for (int dy = -5; dy <= 5; ++dy) {
        if (y + dy < 0 || y + dy >= height) continue;
        const float* const there = slopes.data + (long)(y + dy) * pitch + left + 16 * k;
        const float weight = window[dy < 0 ? -dy : dy];
        for (int q = 0; q < 3; ++q) sums[q] += weight * load16(there + q * plane);
    }
    for (int q = 0; q < 3; ++q) store16(lines[q] + 16 * k, sums[q]);
}
for (int k = 0; k < groups; ++k) {
    v16 means[3];
    for (int q = 0; q < 3; ++q) {
        const float* const p = lines[q] + 16 + 16 * k;
        means[q] = WINDOW_0 * load16(p);
        for (int d = 1; d < 6; ++d) means[q] += window[d] * (load16(p - 3 * d) + load16(p + 3 * d));
    }
    const long at = (long)y * pitch + 16 + left + 16 * k;
    const v16 a = load16(image.data + at), b = load16(photo.data + at);
    store16(gradient.data + at, means[0] + 2.0f * a * means[1] + b * means[2]);
}
