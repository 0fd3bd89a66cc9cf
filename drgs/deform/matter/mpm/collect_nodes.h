// Sums of what the 27 nodes around one particle say: rows sum w v and sum w (n - f)_a v for the three axes a.
// Body of a Warp native function; transfer.py. Plain C++, which Clang turns into four-wide arithmetic.
//
// in   block; x, y, z (the first node, counted from the block's corner: -1..4), f, wx, wy, wz
//      neighbours (block, 27): blocks around; nodes (node): vec4, 4 x 4 x 4 to a block
// out  a 4x4 matrix; its last column means nothing
const int* const around = neighbours.data + (long)(block) * 27;
const float* const values = (const float*)(nodes.data);
wp::mat_t<4, 4, float> sums;
for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) sums.data[r][c] = 0.0f;
for (int i = 0; i < 3; ++i) {
    const int tx = x + i, sx = tx < 0 ? 0 : (tx < 4 ? 1 : 2);
    const float dx = (float)(i) - f[0];
    for (int j = 0; j < 3; ++j) {
        const int ty = y + j, sy = ty < 0 ? 0 : (ty < 4 ? 1 : 2);
        const float dy = (float)(j) - f[1], wij = wx[i] * wy[j];
        for (int k = 0; k < 3; ++k) {
            const int tz = z + k, sz = tz < 0 ? 0 : (tz < 4 ? 1 : 2);
            const int other = around[(sx * 3 + sy) * 3 + sz];
            if (other < 0) continue;  // beyond the room
            const float* const node = values + ((long)(other) * 64 + ((tx & 3) * 4 + (ty & 3)) * 4 + (tz & 3)) * 4;
            const float dz = (float)(k) - f[2], w = wij * wz[k];
            for (int c = 0; c < 4; ++c) {
                const float value = w * node[c];
                sums.data[0][c] += value;
                sums.data[1][c] += dx * value;
                sums.data[2][c] += dy * value;
                sums.data[3][c] += dz * value;
            }
        }
    }
}
return sums;
