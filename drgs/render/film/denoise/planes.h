// How far apart planes.py lays its planes, in numbers. Placed before bodies of native functions, behind its constants.
const auto planes_apart = [](int height, int pitch) -> long { return ((long)height * pitch + PLANE_ROUND - 1) / PLANE_ROUND * PLANE_ROUND + PLANE_SKEW; };
