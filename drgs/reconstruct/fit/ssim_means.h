// One row's segment of an image and a photograph, both under the window of SSIM: its SSIM, and by how much that changes with the means.
// Body of a Warp native function, CPU only; similarity.py puts constants (WINDOW_0 to WINDOW_5, SEGMENT) and simd_vector.h before it.
//
// Images are rows of `pitch` numbers, colours side by side, with 16 empty ones before the picture's `width` and at least 32 after the last segment's.
// in   index (segment of a row), height, width, pitch, image, photo
// out  sums (of a segment's SSIM); slopes (3 planes): of SSIM by the means of image, image^2 and image * photo, 0 outside the picture
const float window[6] = {WINDOW_0, WINDOW_1, WINDOW_2, WINDOW_3, WINDOW_4, WINDOW_5};
const int segments = (width + SEGMENT - 1) / SEGMENT;
const int y = index / segments, left = index % segments * SEGMENT;
const int groups = min_int(SEGMENT, width - left + 15) / 16;
const long plane = (long)height * pitch;
float lines[5][SEGMENT + 32];
for (int k = 0; k < groups + 2; ++k) {
    v16 mean_a(0.0f), mean_b(0.0f), square_a(0.0f), square_b(0.0f), product(0.0f);
    for (int dy = -5; dy <= 5; ++dy) {
        if (y + dy < 0 || y + dy >= height) continue;
        const long at = (long)(y + dy) * pitch + left + 16 * k;
        const v16 a = load16(image.data + at), b = load16(photo.data + at);
        const float weight = window[dy < 0 ? -dy : dy];
        const v16 wa = weight * a, wb = weight * b;
        mean_a += wa;
        mean_b += wb;
        square_a += wa * a;
        square_b += wb * b;
        product += wa * b;
    }
    store16(lines[0] + 16 * k, mean_a);
    store16(lines[1] + 16 * k, mean_b);
    store16(lines[2] + 16 * k, square_a);
    store16(lines[3] + 16 * k, square_b);
    store16(lines[4] + 16 * k, product);
}
const i16 lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
v16 total(0.0f);
for (int k = 0; k < groups; ++k) {
    v16 means[5];
    for (int q = 0; q < 5; ++q) {
        const float* const p = lines[q] + 16 + 16 * k;
        means[q] = WINDOW_0 * load16(p);
        for (int d = 1; d < 6; ++d) means[q] += window[d] * (load16(p - 3 * d) + load16(p + 3 * d));
    }
    const v16 a = means[0], b = means[1];
    const v16 luminance = a * a + b * b + 1e-4f, contrast = means[2] - a * a + means[3] - b * b + 9e-4f;
    const v16 alike = 2.0f * a * b + 1e-4f, together = 2.0f * (means[4] - a * b) + 9e-4f;
    const v16 inverse = 1.0f / (luminance * contrast);
    const v16 ssim = alike * together * inverse;
    const i16 inside = lanes < width - left - 16 * k;
    const v16 none(0.0f);
    total += select(inside, ssim, none);
    float* const out = slopes.data + (long)y * pitch + 16 + left + 16 * k;
    const v16 by_mean = 2.0f * b * (together - alike) * inverse - 2.0f * a * ssim * (1.0f / luminance - 1.0f / contrast);
    store16(out, select(inside, by_mean, none));
    store16(out + plane, select(inside, -ssim / contrast, none));
    store16(out + 2 * plane, select(inside, 2.0f * alike * inverse, none));
}
float sum = 0.0f;
for (int lane = 0; lane < 16; ++lane) sum += total[lane];
sums.data[index] = sum;
