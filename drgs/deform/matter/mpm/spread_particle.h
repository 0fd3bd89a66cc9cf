// Adds one particle to the 27 nodes of its tile: w (start + i q_x + j q_y + k q_z), the fourth component being mass.
// Body of a Warp native function; transfer.py. Plain C++, which Clang turns into four-wide arithmetic.
//
// in   first (index of the tile's node under the particle's first), start, qx, qy, qz, wx, wy, wz
// out  tiles (node): vec4, 8 x 8 x 8 to a tile
float* const tile = (float*)(tiles.data + first);
for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
        const float wij = wx[i] * wy[j];
        float row[4];
        for (int c = 0; c < 4; ++c) row[c] = start[c] + (float)(i) * qx[c] + (float)(j) * qy[c];
        for (int k = 0; k < 3; ++k) {
            float* const node = tile + ((i * 8 + j) * 8 + k) * 4;
            const float w = wij * wz[k];
            for (int c = 0; c < 4; ++c) {
                const float value = w * (row[c] + (float)(k) * qz[c]);
#if defined(__CUDA_ARCH__)
                atomicAdd(node + c, value);
#else
                node[c] += value;
#endif
            }
        }
    }
