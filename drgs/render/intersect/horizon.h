// raise_horizons of horizon_kernels.py for one face against 16 triangles at a time, CPU only. Body of a Warp native function; horizon_kernels.py
// puts simd_vector.h and the constants before it. A test keeps both equal.
//
// in   f (face), lanes (group, 9, 16: corners by coordinate), group_boxes (group of groups, 6, 16), super_boxes (16 of those, 6, 16), corners, lift
// out  tangent_out[8 f ..]: of each sector of azimuth, in the order of horizon_sector
struct P3 { float x, y, z; };
const auto dot = [](P3 a, P3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
const auto minus = [](P3 a, P3 b) { return P3{a.x - b.x, a.y - b.y, a.z - b.z}; };
const auto cross = [](P3 a, P3 b) { return P3{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; };
const auto scaled = [](P3 a, float s) { return P3{a.x * s, a.y * s, a.z * s}; };
const auto unit = [&](P3 a) { const float l = __builtin_sqrtf(dot(a, a)); return scaled(a, l > 0.0f ? 1.0f / l : 0.0f); };
const auto largest = [](float a, float b) { return a > b ? a : b; };
const auto smallest = [](float a, float b) { return a < b ? a : b; };
const P3* const corner = (const P3*)corners.data + 3 * (long)f;
const P3 a = corner[0], b = corner[1], c = corner[2];
const P3 area = cross(minus(b, a), minus(c, a));
const float length = __builtin_sqrtf(dot(area, area));
if (!(length > 0.0f)) {
    for (int k = 0; k < 8; ++k) tangent_out.data[8 * (long)f + k] = 1e30f;
    return;
}
const P3 n = scaled(area, 1.0f / length);
const float base = largest(largest(dot(n, a), dot(n, b)), dot(n, c)) + 0.5f * lift;
// The frame of horizon_sector; near the pole, where it turns with the slightest tilt, all sectors get the highest horizon.
const float across_z = __builtin_sqrtf(n.x * n.x + n.y * n.y);
const P3 u = unit(across_z > 0.0f ? P3{-n.y, n.x, 0.0f} : P3{1.0f, 0.0f, 0.0f}), v = cross(n, u);
P3 h[DIRECTIONS];
float support[DIRECTIONS], behind[8];
const float turn[8][2] = {{1, 0}, {0.70710678f, 0.70710678f}, {0, 1}, {-0.70710678f, 0.70710678f},
                          {-1, 0}, {-0.70710678f, -0.70710678f}, {0, -1}, {0.70710678f, -0.70710678f}};
for (int k = 0; k < 8; ++k) h[k] = {turn[k][0] * u.x + turn[k][1] * v.x, turn[k][0] * u.y + turn[k][1] * v.y, turn[k][0] * u.z + turn[k][1] * v.z};
h[8] = unit(cross(minus(b, a), n));
h[9] = unit(cross(minus(c, b), n));
h[10] = unit(cross(minus(a, c), n));
for (int k = 0; k < DIRECTIONS; ++k) support[k] = largest(largest(dot(h[k], a), dot(h[k], b)), dot(h[k], c));
for (int k = 0; k < 8; ++k) behind[k] = smallest(smallest(dot(h[k], a), dot(h[k], b)), dot(h[k], c)) - lift;
float tangents[8] = {0.0f};  // of sector k: azimuths from h[k] to h[k + 1]
float least = 0.0f;
const auto absolute = [](float x) { return x < 0.0f ? -x : x; };
// What lies behind the whole face along a direction within 90 degrees of all of a sector is out of that sector's reach.
const auto in_sector = [](const i16* passed, int k) -> i16 { return ~(passed[(k + 7) & 7] | passed[k] | passed[(k + 1) & 7] | passed[(k + 2) & 7]); };
// The lowest horizon found so far of the sectors that things are in; 1e30 where they are in none that could still be of use.
const auto least_around = [&](const i16* passed) -> v16 {
    v16 least_there(1e30f);
    for (int k = 0; k < 8; ++k)
        if (tangents[k] < STEEPEST) least_there = min16(least_there, select(in_sector(passed, k), v16(tangents[k]), v16(1e30f)));
    return least_there;
};
// Which of 16 boxes, (6, 16): lowest and highest corners by coordinate, may hold something above the tangent found so far.
const auto boxes_above = [&](const float* boxes) -> i16 {
    v16 middle[3], half[3];
    for (int k = 0; k < 3; ++k) {
        const v16 low = load16(boxes + 16 * k), high = load16(boxes + 48 + 16 * k);
        middle[k] = 0.5f * (low + high);
        half[k] = 0.5f * (high - low);
    }
    const auto along = [&](P3 d) -> v16 { return d.x * middle[0] + d.y * middle[1] + d.z * middle[2]; };
    const auto across = [&](P3 d) -> v16 { return absolute(d.x) * half[0] + absolute(d.y) * half[1] + absolute(d.z) * half[2]; };
    const v16 above = along(n) + across(n) - base;
    i16 open = above > 0.0f, passed[8];
    if (!any(open)) return open;
    v16 beyond[DIRECTIONS];
    for (int k = 0; k < DIRECTIONS; ++k) {
        const v16 middle_along = along(h[k]), half_along = across(h[k]);
        beyond[k] = middle_along - half_along - support[k];
        if (k < 8) passed[k] = middle_along + half_along < behind[k];
    }
    const v16 reach = least_around(passed);
    for (int k = 0; k < DIRECTIONS; ++k) open &= ~((beyond[k] > 0.0f) & (above <= reach * beyond[k]));
    return open & (reach < 1e30f);
};
const auto against = [&](const float* lane) {
    v16 x[3], y[3], z[3], above[3];
    for (int p = 0; p < 3; ++p) {
        x[p] = load16(lane + 48 * p);
        y[p] = load16(lane + 48 * p + 16);
        z[p] = load16(lane + 48 * p + 32);
        above[p] = n.x * x[p] + n.y * y[p] + n.z * z[p] - base;
    }
    i16 open = max16(max16(above[0], above[1]), above[2]) > 0.0f;
    if (!any(open)) return;
    const float tolerance = 0.1f * lift;
    v16 beyond[DIRECTIONS][3];
    i16 passed[8];
    for (int k = 0; k < DIRECTIONS; ++k) {
        v16 farthest(-1e30f);
        for (int p = 0; p < 3; ++p) {
            const v16 along = h[k].x * x[p] + h[k].y * y[p] + h[k].z * z[p];
            beyond[k][p] = along - support[k];
            farthest = max16(farthest, along);
        }
        if (k < 8) passed[k] = farthest < behind[k];
    }
    // First by products alone: most triangles lie below the horizons found so far.
    const v16 reach = least_around(passed);
    open &= reach < 1e30f;
    for (int k = 0; k < DIRECTIONS; ++k) {
        i16 below = open;
        for (int p = 0; p < 3; ++p)
            below &= ((above[p] <= 0.0f) & (beyond[k][p] >= -tolerance)) | ((beyond[k][p] > 0.0f) & (above[p] <= reach * beyond[k][p]));
        open &= ~below;
        if (!any(open)) return;
    }
    v16 lowest(1e30f);
    for (int k = 0; k < DIRECTIONS; ++k) {
        v16 needed(0.0f);
        for (int p = 0; p < 3; ++p) {
            const v16 under = select(beyond[k][p] >= -tolerance, v16(0.0f), v16(1e30f));
            const v16 over = select(beyond[k][p] > 0.0f, above[p] / max16(beyond[k][p], v16(1e-30f)), v16(1e30f));
            needed = max16(needed, select(above[p] <= 0.0f, under, over));
        }
        lowest = min16(lowest, needed);
    }
    least = 1e30f;
    for (int k = 0; k < 8; ++k) {
        const float found = __builtin_reduce_max(select(open & in_sector(passed, k), lowest, v16(0.0f)));
        tangents[k] = largest(tangents[k], found);
        least = smallest(least, tangents[k]);
    }
};
const auto look_into = [&](int super) {
    alignas(64) int open[16];
    *(i16*)open = boxes_above(group_boxes.data + 96 * (long)super);
    for (int k = 0; k < 16 && least < STEEPEST; ++k)
        if (open[k] != 0) against((const float*)lanes.data + 144 * (16 * (long)super + k));
};
// The face's own neighbourhood first: it is what most often shows that there is nothing to gain.
const int blocks = super_boxes.shape[0] / 96, own = f / 256;
look_into(own);
for (int step = 0; step < blocks && least < STEEPEST; ++step) {
    const int block = (own / 16 + step) % blocks;
    alignas(64) int open[16];
    *(i16*)open = boxes_above(super_boxes.data + 96 * (long)block);
    for (int k = 0; k < 16 && least < STEEPEST; ++k)
        if (open[k] != 0 && 16 * block + k != own) look_into(16 * block + k);
}
const int order[8] = {0, 4, 5, 1, 3, 7, 6, 2};
float most = 0.0f;
for (int k = 0; k < 8; ++k) most = largest(most, tangents[k]);
for (int k = 0; k < 8; ++k) tangent_out.data[8 * (long)f + order[k]] = across_z < POLE ? most : tangents[k];
