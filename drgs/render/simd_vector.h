// 16 pixels side by side: what both tile loops share. Placed at the head of a native function's body.
// Warp defines float(x) and int(x) as macros: only C-style casts here.
typedef float v16 __attribute__((ext_vector_type(16)));
typedef int i16 __attribute__((ext_vector_type(16)));
typedef float v16u __attribute__((ext_vector_type(16), aligned(4)));
typedef float v8 __attribute__((ext_vector_type(8)));
typedef float v4 __attribute__((ext_vector_type(4)));
const auto select = [](i16 mask, v16 a, v16 b) { return mask ? a : b; };
const auto min16 = [](v16 a, v16 b) { return __builtin_elementwise_min(a, b); };
const auto max16 = [](v16 a, v16 b) { return __builtin_elementwise_max(a, b); };
const auto abs16 = [](v16 a) { return __builtin_elementwise_abs(a); };
const auto sqrt16 = [](v16 a) { return __builtin_elementwise_sqrt(a); };
const auto any = [](i16 mask) { return __builtin_reduce_or(mask) != 0; };
const auto max_int = [](int a, int b) { return a > b ? a : b; };
const auto min_int = [](int a, int b) { return a < b ? a : b; };
const auto load16 = [](const float* p) -> v16 { return *(const v16u*)p; };
const auto store16 = [](float* p, v16 a) { *(v16u*)p = a; };
// Sums of 16 vectors at once, as the lanes of one: a tree of shuffles, a third of the work of 16 separate sums.
#define PAIR_SUM(a, b, ...) (__builtin_shufflevector(a, b, EVEN_##__VA_ARGS__) + __builtin_shufflevector(a, b, ODD_##__VA_ARGS__))
#define EVEN_1 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30
#define ODD_1 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31
#define EVEN_2 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29
#define ODD_2 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31
#define EVEN_4 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27
#define ODD_4 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31
#define EVEN_8 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23
#define ODD_8 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31
const auto sums16 = [](const v16* a) -> v16 {
    v16 b[8], c[4];
    for (int k = 0; k < 8; ++k) b[k] = PAIR_SUM(a[2 * k], a[2 * k + 1], 1);
    for (int k = 0; k < 4; ++k) c[k] = PAIR_SUM(b[2 * k], b[2 * k + 1], 2);
    const v16 d0 = PAIR_SUM(c[0], c[1], 4), d1 = PAIR_SUM(c[2], c[3], 4);
    return PAIR_SUM(d0, d1, 8);
};
// exp(-a) for a >= 0: 2^n 2^f with f in [-0.5, 0.5], a degree-6 polynomial; relative error below 2e-7, 0 beyond a = 87
const auto exp_negative = [](v16 a) -> v16 {
    const v16 t = __builtin_elementwise_max(a * -1.44269504f, v16(-126.0f));
    const v16 n = __builtin_elementwise_roundeven(t);
    const v16 f = t - n;
    v16 p = f * 1.5403530e-4f + 1.3333558e-3f;
    p = p * f + 9.6181291e-3f;
    p = p * f + 5.5504109e-2f;
    p = p * f + 2.4022651e-1f;
    p = p * f + 6.9314718e-1f;
    p = p * f + 1.0f;
    const i16 bits = (__builtin_convertvector(n, i16) + 127) << 23;
    return p * __builtin_bit_cast(v16, bits);
};
// The same for weights: a degree-4 polynomial, the power of two added to its exponent; 0 <= a <= 87, relative error below 6e-5.
const auto exp_negative_roughly = [](v16 a) -> v16 {
    const v16 shifter(12582912.0f);  // what is added to it is rounded to an integer, in its lowest bits
    const v16 n = a * -1.44269504f + shifter;
    const v16 f = a * -1.44269504f - (n - shifter);
    v16 p = f * 9.6181291e-3f + 5.5504109e-2f;
    p = p * f + 2.4022651e-1f;
    p = p * f + 6.9314718e-1f;
    p = p * f + 1.0f;
    return __builtin_bit_cast(v16, __builtin_bit_cast(i16, p) + (__builtin_bit_cast(i16, n) << 23));
};
// 1 / sqrt(a) for normal a > 0, by a guess from the bits and two of Newton's steps; relative error below 5e-6.
const auto inverse_sqrt_by_steps = [](v16 a) -> v16 {
    v16 guess = __builtin_bit_cast(v16, 0x5f3759df - (__builtin_bit_cast(i16, a) >> 1));
    for (int k = 0; k < 2; ++k) guess *= 1.5f - 0.5f * a * guess * guess;
    return guess;
};
// The same where a processor has it ready; relative error below 1e-4. Roots and quotients take many times as long.
const auto inverse_sqrt_roughly = [&](v16 a) -> v16 {  // & for processors that have it not
#if defined(__AVX512F__)
    return __builtin_ia32_rsqrt14ps512_mask(a, a, -1);
#else
    return inverse_sqrt_by_steps(a);
#endif
};
