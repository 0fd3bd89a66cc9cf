// A tile of 16x16 pixels as 16 blocks of 4x4, numbered by rows of blocks; the lanes of a block are its pixels by rows.
const auto block_x = []() -> v16 {
    return v16{0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f};
};
const auto block_y = []() -> v16 {
    return v16{0.5f, 0.5f, 0.5f, 0.5f, 1.5f, 1.5f, 1.5f, 1.5f, 2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};
};
// `corner` is the tile's first pixel in a plane whose rows are `stride` pixels apart.
const auto load_block = [](const float* corner, int stride, int block) -> v16 {
    const float* const p = corner + (long)(block / 4 * 4) * stride + block % 4 * 4;
    v16 a;
    for (int k = 0; k < 16; ++k) a[k] = p[(long)(k / 4) * stride + k % 4];
    return a;
};
const auto store_block = [](float* corner, int stride, int block, v16 a) {
    float* const p = corner + (long)(block / 4 * 4) * stride + block % 4 * 4;
    for (int k = 0; k < 16; ++k) p[(long)(k / 4) * stride + k % 4] = a[k];
};
// Surfels of a list lie anywhere in memory: what one of a few entries later needs is asked for now.
const auto prefetch_rows = [](const float* row, int numbers) {
    for (int k = 0; k < numbers; k += 16) __builtin_prefetch(row + k);
    __builtin_prefetch(row + numbers - 1);
};
constexpr int AHEAD = 6;
