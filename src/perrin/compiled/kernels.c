/* Compiled twins of functions of perrin that spend their time in arithmetic on small matrices.
 *
 * Only the stable ABI of Python 3.11 is used: one binary serves every later version, and arrays
 * arrive as buffers. Compilers of the GNU family work on several rows at once in vectors; others
 * work on one row at a time. Without contracted multiplications (-ffp-contract=off) both, and every
 * instruction set, round alike; but for sums over modes, which are added in another order where
 * there are no vectors.
 */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(__GNUC__)
#define WIDTH 4
#define INLINE static inline __attribute__((always_inline))
typedef double Lanes __attribute__((vector_size(8 * WIDTH)));
typedef int64_t Mask __attribute__((vector_size(8 * WIDTH)));
#define LANE(vector, i) ((vector)[i])
INLINE Lanes choose(Mask mask, Lanes a, Lanes b)
{
    return (Lanes)((mask & (Mask)a) | (~mask & (Mask)b));
}
INLINE Lanes magnitude(Lanes a) { return (Lanes)((Mask)a & INT64_MAX); }
INLINE Lanes square_root(Lanes a)
{
    for (int i = 0; i < WIDTH; i++)
        a[i] = sqrt(a[i]);
    return a;
}
INLINE int any(Mask mask)
{
    int64_t found = 0;
    for (int i = 0; i < WIDTH; i++)
        found |= mask[i];
    return found != 0;
}
/* One over the factorials of 13 to 0. */
static const double series[] = {
    1.6059043836821613e-10, 2.08767569878681e-09, 2.505210838544172e-08, 2.755731922398589e-07,
    2.7557319223985893e-06, 2.48015873015873e-05, 0.0001984126984126984, 0.001388888888888889,
    0.008333333333333333, 0.041666666666666664, 0.16666666666666666, 0.5, 1.0, 1.0};

/* e^x for x <= 0, and 0 where that is below the normal numbers: 2^n times the series of e^r, with r
 * at most half of ln 2, which is taken off in two parts. The sum x/ln 2 + 1.5 2^52 ends with n. */
INLINE Lanes exponential(Lanes x)
{
    const double shift = 6755399441055744.0;
    Lanes shifted = x * 1.44269504088896340736 + shift, n = shifted - shift, none = {0.0};
    Lanes r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    Lanes sum = none;
    for (int k = 0; k < 14; k++)
        sum = series[k] + sum * r;
    Mask exponent = (Mask)shifted - (Mask)(none + shift) + 1023;
    return choose(x < -708.0, none, sum * (Lanes)(exponent << 52));
}
#else
#define WIDTH 1
#define INLINE static __inline
typedef double Lanes;
typedef int Mask;
#define LANE(vector, i) (vector)
INLINE Lanes choose(Mask mask, Lanes a, Lanes b) { return mask ? a : b; }
INLINE Lanes magnitude(Lanes a) { return fabs(a); }
INLINE Lanes square_root(Lanes a) { return sqrt(a); }
INLINE int any(Mask mask) { return mask; }
INLINE Lanes exponential(Lanes x) { return exp(x); }
#endif

/* The loader chooses among versions of a function for the vector registers of the machine. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__)
#define EVERY_MACHINE __attribute__((target_clones("avx2", "default")))
#else
#define EVERY_MACHINE
#endif

INLINE Lanes larger(Lanes a, Lanes b) { return choose(a > b, a, b); }
INLINE Lanes all_equal(double value)
{
    Lanes same;
    for (int i = 0; i < WIDTH; i++)
        LANE(same, i) = value;
    return same;
}

/* Up to this many steps of Newton's method towards the largest root of the quartic. */
enum { MOST_STEPS = 30 };

/* Point sets of `rows` rows of n points; a stride of 0 repeats one set for all rows. */
typedef struct {
    Py_ssize_t rows, n, stride_y, stride_x, stride_w;
    const double *y, *x, *w;
    double *rotation;
    uint8_t *certain;
} Sets;

INLINE void cross(const Lanes a[3], const Lanes b[3], Lanes out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* out = a b, or a^T b. */
INLINE void product(Lanes a[3][3], Lanes b[3][3], int transposed, Lanes out[3][3])
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[i][j] = transposed ? a[0][i] * b[0][j] + a[1][i] * b[1][j] + a[2][i] * b[2][j]
                                   : a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

/* Copy WIDTH rows of n numbers to `out` (n), one row a lane; where rows end, the last is repeated. */
INLINE void gather(const double *set, Py_ssize_t stride, Py_ssize_t n, Py_ssize_t count, Lanes *out)
{
    for (int lane = 0; lane < WIDTH; lane++) {
        const double *row = set + (lane < count ? lane : count - 1) * stride;
        for (Py_ssize_t i = 0; i < n; i++)
            LANE(out[i], lane) = row[i];
    }
}

INLINE void centre(Lanes *points, const Lanes *weight, Py_ssize_t n, Lanes total, Lanes mean[3])
{
    for (int k = 0; k < 3; k++)
        mean[k] = all_equal(0.0);
    for (Py_ssize_t i = 0; i < n; i++)
        for (int k = 0; k < 3; k++)
            mean[k] += weight ? points[3 * i + k] * weight[i] : points[3 * i + k];
    for (int k = 0; k < 3; k++)
        mean[k] = mean[k] / total;
    for (Py_ssize_t i = 0; i < n; i++)
        for (int k = 0; k < 3; k++)
            points[3 * i + k] -= mean[k];
}

/* The cross-dispersion sum w y x^T of centred sets and a bound of its rounding error. */
INLINE Lanes dispersion(Lanes *y, Lanes *x, const Lanes *w, Py_ssize_t n, Lanes c[3][3])
{
    Lanes total = all_equal((double)n), y0[3], x0[3], zero = all_equal(0.0);
    if (w) {
        total = zero;
        for (Py_ssize_t i = 0; i < n; i++)
            total += w[i];
        total = larger(total, all_equal(1e-300));
    }
    centre(y, w, n, total, y0);
    centre(x, w, n, total, x0);
    for (int j = 0; j < 3; j++)
        for (int k = 0; k < 3; k++)
            c[j][k] = zero;
    Lanes y_size = zero, x_size = zero, y_largest = zero, far_y = zero, far_x = zero;
    for (Py_ssize_t i = 0; i < n; i++)
        for (int k = 0; k < 3; k++) {
            Lanes x_weighted = w ? x[3 * i + k] * w[i] : x[3 * i + k];
            Lanes y_distance = magnitude(y[3 * i + k]);
            for (int j = 0; j < 3; j++)
                c[j][k] += y[3 * i + j] * x_weighted;
            x_size += magnitude(x_weighted);
            y_size += w ? y_distance * w[i] : y_distance;
            y_largest = larger(y_distance, y_largest);
        }
    for (int k = 0; k < 3; k++) {
        far_y = larger(magnitude(y0[k]), far_y);
        far_x = larger(magnitude(x0[k]), far_x);
    }
    Lanes near = y_largest * x_size * (double)n;
    return 8 * DBL_EPSILON * (near + (far_y * x_size + far_x * y_size));
}

/* The largest root of (l^2 - 1)^2 - 8 l det - 4 cofactor2, and the gap to the next one. */
INLINE Lanes characteristic_root(Lanes det, Lanes cofactor2, Lanes *gap)
{
    Lanes root = all_equal(sqrt(3.0)), tiny = all_equal(1e-12);
    for (int step = 0; step < MOST_STEPS; step++) {
        Lanes square = root * root - 1.0;
        Lanes slope = 0.5 * root * square - det;
        Lanes value = 0.125 * square * square - root * det - 0.5 * cofactor2;
        Lanes change = value / larger(slope, tiny);
        root = root - change;
        if (!any(magnitude(change) > 1e-9))
            break;
    }
    *gap = 0.5 * root * (root * root - 1.0) - det;
    return root;
}

/* Solve (tr S - sym S) w = axial(S - S^T) and return where that matrix is positive definite. */
INLINE Mask newton_step(Lanes s[3][3], Lanes w[3])
{
    Lanes trace = s[0][0] + s[1][1] + s[2][2];
    Lanes p = trace - s[0][0], q = trace - s[1][1], r = trace - s[2][2];
    Lanes f = -0.5 * (s[0][1] + s[1][0]);
    Lanes g = -0.5 * (s[0][2] + s[2][0]);
    Lanes h = -0.5 * (s[1][2] + s[2][1]);
    Lanes a[3] = {s[2][1] - s[1][2], s[0][2] - s[2][0], s[1][0] - s[0][1]};
    Lanes m00 = q * r - h * h, m01 = g * h - f * r, m02 = f * h - g * q;
    Lanes m11 = p * r - g * g, m12 = f * g - p * h, m22 = p * q - f * f;
    Lanes zero = all_equal(0.0), det = p * m00 + f * m01 + g * m02;
    Mask definite = (p > zero) & (m22 > zero) & (det > zero);
    Lanes divisor = choose(definite, det, all_equal(1.0));
    w[0] = (m00 * a[0] + m01 * a[1] + m02 * a[2]) / divisor;
    w[1] = (m01 * a[0] + m11 * a[1] + m12 * a[2]) / divisor;
    w[2] = (m02 * a[0] + m12 * a[1] + m22 * a[2]) / divisor;
    return definite;
}

/* Markley's closed form, one orthonormalising and one Newton step; returns where it is certain. */
INLINE Mask certified_rotation(Lanes b[3][3], Lanes error, Lanes r[3][3])
{
    Lanes zero = all_equal(0.0), one = all_equal(1.0), largest = zero, norm = zero;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            largest = larger(magnitude(b[i][j]), largest);
    Lanes scale = one / choose(largest > zero, largest, one);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            b[i][j] *= scale;
            norm += b[i][j] * b[i][j];
        }
    norm = square_root(norm);
    scale = one / choose(norm > zero, norm, one);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            b[i][j] *= scale;
    Lanes cofactor[3][3], cofactor2 = zero, gap;
    for (int i = 0; i < 3; i++)
        cross(b[(i + 1) % 3], b[(i + 2) % 3], cofactor[i]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            cofactor2 += cofactor[i][j] * cofactor[i][j];
    Lanes det = b[0][0] * cofactor[0][0] + b[0][1] * cofactor[0][1] + b[0][2] * cofactor[0][2];
    Lanes root = characteristic_root(det, cofactor2, &gap);
    Lanes gram[3][3], cubic[3][3], inverse = one / larger(gap, all_equal(1e-12));
    product(b, b, 1, gram);
    product(b, gram, 0, cubic);
    Lanes factor = 0.5 * (root * root + 1.0);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            r[i][j] = (factor * b[i][j] + root * cofactor[i][j] - cubic[i][j]) * inverse;
    product(r, r, 1, gram);
    product(r, gram, 0, cubic);
    Lanes schulz2 = zero;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            Lanes schulz = 0.5 * (r[i][j] - cubic[i][j]);
            schulz2 += schulz * schulz;
            r[i][j] += schulz;
        }
    Lanes s[3][3], step[3], turned[3];
    product(r, b, 1, s);
    Mask definite = newton_step(s, step);
    Lanes step2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
    for (int i = 0; i < 3; i++) {
        cross(r[i], step, turned);
        for (int j = 0; j < 3; j++)
            r[i][j] += turned[j];
    }
    return definite & (schulz2 < all_equal(1e-16)) & (step2 < 1e-14 * gap) &
           (gap > all_equal(1e-7)) & (0.5 * gap * norm * largest > error);
}

/* Give points of which a coordinate is NaN the weight 0, and that coordinate the value 0. */
INLINE void leave_out_absent(Lanes *y, Lanes *x, Lanes *w, Py_ssize_t n)
{
    Lanes zero = all_equal(0.0);
    for (Py_ssize_t i = 0; i < 3 * n; i++) {
        Mask y_here = y[i] == y[i], x_here = x[i] == x[i];
        w[i / 3] = choose(y_here & x_here, w[i / 3], zero);
        y[i] = choose(y_here, y[i], zero);
        x[i] = choose(x_here, x[i], zero);
    }
}

/* Read WIDTH rows of both sets, and of the weights if they are given. */
INLINE void read_rows(const Sets *sets, Py_ssize_t row, Lanes *y, Lanes *x, Lanes *w)
{
    Py_ssize_t n = sets->n, count = sets->rows - row < WIDTH ? sets->rows - row : WIDTH;
    gather(sets->y + row * sets->stride_y, sets->stride_y, 3 * n, count, y);
    gather(sets->x + row * sets->stride_x, sets->stride_x, 3 * n, count, x);
    if (sets->w)
        gather(sets->w + row * sets->stride_w, sets->stride_w, n, count, w);
}

EVERY_MACHINE
static void solve(const Sets *sets, Lanes *y, Lanes *x, Lanes *w)
{
    Py_ssize_t n = sets->n;
    for (Py_ssize_t row = 0; row < sets->rows; row += WIDTH) {
        Py_ssize_t count = sets->rows - row < WIDTH ? sets->rows - row : WIDTH;
        Lanes c[3][3], r[3][3];
        read_rows(sets, row, y, x, w);
        Lanes error = dispersion(y, x, sets->w ? w : NULL, n, c);
        if (any(error - error != all_equal(0.0))) {
            for (Py_ssize_t i = 0; i < n; i++)
                w[i] = all_equal(1.0);
            read_rows(sets, row, y, x, w);
            leave_out_absent(y, x, w, n);
            error = dispersion(y, x, w, n, c);
        }
        Mask certain = certified_rotation(c, error, r);
        for (int lane = 0; lane < count; lane++) {
            double *out = sets->rotation + 9 * (row + lane);
            for (int i = 0; i < 9; i++)
                out[i] = LANE(r[i / 3][i % 3], lane);
            sets->certain[row + lane] = LANE(certain, lane) != 0;
        }
    }
}

/* A window of voxels, and the spheres whose images are wanted on the `count` voxels of its mask. */
typedef struct {
    Py_ssize_t spheres, shape[3], count, knots[2], table_stride;
    const uint8_t *mask;
    const double *center, *voxel, *reach, *spacing, *table;
    double *out;
} Window;

/* The voxels of one axis that an image covers. */
typedef struct {
    Py_ssize_t first, stop;
} Range;

static Range covered(double center, double reach, double voxel, Py_ssize_t n)
{
    double first = ceil((center - reach) / voxel), stop = floor((center + reach) / voxel) + 1;
    Range range = {first < 0 ? 0 : (Py_ssize_t)first, stop < 0 ? 0 : (Py_ssize_t)stop};
    range.first = first > (double)n ? n : range.first;
    range.stop = stop > (double)n ? n : range.stop;
    return range;
}

/* The four cubic B-splines at t among `count` padded knots, and their slopes. */
typedef struct {
    Py_ssize_t first;
    double value[4], slope[4];
} Splines;

static Splines splines_at(double t, Py_ssize_t count)
{
    Splines s = {.first = t < (double)(count - 4) ? (Py_ssize_t)t : count - 4};
    double u = t - (double)s.first, v;
    u = u < 1.0 ? u : 1.0;
    v = 1.0 - u;
    s.value[0] = v * v * v / 6;
    s.value[1] = 2.0 / 3 - u * u + u * u * u / 2;
    s.value[2] = 2.0 / 3 - v * v + v * v * v / 2;
    s.value[3] = u * u * u / 6;
    s.slope[0] = -v * v / 2;
    s.slope[1] = -2 * u + 1.5 * u * u;
    s.slope[2] = 2 * v - 1.5 * v * v;
    s.slope[3] = u * u / 2;
    return s;
}

/* A pixel of the window: splines in the distance from the sphere's axis, and its offsets. */
typedef struct {
    Splines across;
    double y, x;
} Pixel;

/* Write image and gradient (4, count) of one sphere; `rows` holds two rows of the table. */
static void write_spot(const Window *window, const double *center, const double *table,
                       Pixel *pixels, double *rows, double *out)
{
    const Py_ssize_t *shape = window->shape, columns = window->knots[1], count = window->count;
    double spacing_z = window->spacing[0], spacing_rho = window->spacing[1];
    Range range[3];
    for (int k = 0; k < 3; k++)
        range[k] = covered(center[k], window->reach[k], window->voxel[k], shape[k]);
    for (Py_ssize_t j = range[1].first; j < range[1].stop; j++)
        for (Py_ssize_t i = range[2].first; i < range[2].stop; i++) {
            Pixel *pixel = pixels + j * shape[2] + i;
            pixel->y = window->voxel[1] * (double)j - center[1];
            pixel->x = window->voxel[2] * (double)i - center[2];
            double rho = sqrt(pixel->y * pixel->y + pixel->x * pixel->x);
            pixel->across = splines_at(rho / spacing_rho, columns);
            for (int k = 0; k < 4; k++)
                pixel->across.slope[k] /= spacing_rho * (rho > 0 ? rho : 1.0);
        }
    double *value_row = rows, *slope_row = rows + columns;
    const uint8_t *mask = window->mask;
    Py_ssize_t number = 0;
    for (Py_ssize_t l = 0; l < shape[0]; l++) {
        int covers_plane = l >= range[0].first && l < range[0].stop;
        if (covers_plane) {
            double z = window->voxel[0] * (double)l - center[0];
            double outward = z > 0 ? -1 / spacing_z : z < 0 ? 1 / spacing_z : 0.0;
            Splines along = splines_at(fabs(z) / spacing_z, window->knots[0]);
            const double *knots = table + along.first * columns;
            for (Py_ssize_t c = 0; c < columns; c++) {
                value_row[c] = slope_row[c] = 0.0;
                for (int k = 0; k < 4; k++) {
                    value_row[c] += along.value[k] * knots[k * columns + c];
                    slope_row[c] += along.slope[k] * knots[k * columns + c] * outward;
                }
            }
        }
        for (Py_ssize_t j = 0; j < shape[1]; j++) {
            int covers_line = covers_plane && j >= range[1].first && j < range[1].stop;
            for (Py_ssize_t i = 0; i < shape[2]; i++) {
                if (!*mask++)
                    continue;
                double value = 0.0, by_z = 0.0, by_rho = 0.0, y = 0.0, x = 0.0;
                if (covers_line && i >= range[2].first && i < range[2].stop) {
                    const Pixel *pixel = pixels + j * shape[2] + i;
                    const Splines *across = &pixel->across;
                    for (int k = 0; k < 4; k++) {
                        value += value_row[across->first + k] * across->value[k];
                        by_z += slope_row[across->first + k] * across->value[k];
                        by_rho += value_row[across->first + k] * across->slope[k];
                    }
                    y = pixel->y;
                    x = pixel->x;
                }
                out[number] = value;
                out[count + number] = by_z;
                out[2 * count + number] = -by_rho * y;
                out[3 * count + number] = -by_rho * x;
                number++;
            }
        }
    }
}

/* Modes of steps: so many of them are summed before their logarithms are added; no more components
 * than a body has coordinates. */
enum { TRACK_BLOCK = 512, MOST_AXES = 3 };

/* The logarithms of normal numbers: the product of their fractions, and the sum of their exponents
 * as they stand in the numbers. Up to TRACK_BLOCK of them have a finite product. */
typedef struct {
    Lanes product;
    uint64_t exponents[WIDTH];
} Logarithm;

INLINE void add_logarithm(Logarithm *sum, Lanes number)
{
    uint64_t bits[WIDTH];
    memcpy(bits, &number, sizeof bits);
    for (int i = 0; i < WIDTH; i++) {
        sum->exponents[i] += bits[i] >> 52;
        bits[i] = (bits[i] & 0xFFFFFFFFFFFFFULL) | 0x3FF0000000000000ULL; /* from 1 to 2 */
    }
    memcpy(&number, bits, sizeof bits);
    sum->product *= number;
}

/* Sum of the logarithms of the `added` numbers in a lane. */
INLINE double lane_logarithm(const Logarithm *sum, int lane, Py_ssize_t added)
{
    int64_t exponent = (int64_t)sum->exponents[lane] - 1023 * (int64_t)added;
    return log(LANE(sum->product, lane)) + (double)exponent * 0.69314718055994530942;
}

INLINE double logarithm(const Logarithm *sum, Py_ssize_t added)
{
    double found = 0.0;
    for (int i = 0; i < WIDTH; i++)
        found += lane_logarithm(sum, i, added);
    return found;
}

/* The next modes of a track, of which `left` are left; `fill` in the place of those beyond. */
INLINE Lanes next_modes(const double *modes, Py_ssize_t left, double fill)
{
    Lanes found = all_equal(fill);
    if (left >= WIDTH)
        memcpy(&found, modes, sizeof found);
    else
        for (Py_ssize_t i = 0; i < left; i++)
            LANE(found, i) = modes[i];
    return found;
}

INLINE double sum_of_lanes(Lanes lanes)
{
    double sum = 0.0;
    for (int i = 0; i < WIDTH; i++)
        sum += LANE(lanes, i);
    return sum;
}

/* Modes (rows or 1, b, count) of P rows, in the axes (P, b, b) in which they are independent. */
typedef struct {
    Py_ssize_t rows, count, b, stride, columns;
    const double *modes, *axes, *share, *weight;
    double *sums;
} Modes;

/* The sums of one row over a block of modes. */
typedef struct {
    Logarithm variance[MOST_AXES];
    Lanes form, least, same[MOST_AXES][MOST_AXES], next[MOST_AXES][MOST_AXES];
    Lanes power[MOST_AXES][MOST_AXES][3][MOST_AXES], trace[MOST_AXES][3][MOST_AXES];
} ModeSums;

/* Variances of the next modes along an axis; 1 beyond the last of them. */
INLINE Lanes variance_of(double share, Lanes weight, Py_ssize_t left)
{
    Lanes variance = share + 0.5 * weight * (1 - share);
    for (Py_ssize_t i = left; i < WIDTH; i++)
        LANE(variance, i) = 1.0;
    return variance;
}

/* Add to the sums of one row those of the `left` modes from `k` on, at most WIDTH of them. */
INLINE void add_modes(const Modes *all, Py_ssize_t row, Py_ssize_t k, Py_ssize_t left, int b,
                      int curved, ModeSums *sums)
{
    const double *modes = all->modes + row * all->stride + k, *share = all->share + row * b;
    const double *axes = all->axes + row * b * b;
    Lanes w = next_modes(all->weight + k, left, 0.0);
    Lanes y[MOST_AXES], inverse[MOST_AXES], scaled[MOST_AXES], weighted[3][MOST_AXES];
    for (int c = 0; c < b; c++)
        y[c] = next_modes(modes + c * all->count, left, 0.0);
    for (int a = 0; a < b; a++) {
        Lanes along = y[0] * axes[a], variance = variance_of(share[a], w, left);
        for (int c = 1; c < b; c++)
            along += y[c] * axes[c * b + a];
        add_logarithm(&sums->variance[a], variance);
        sums->least = -larger(-sums->least, -variance);
        inverse[a] = 1 / variance;
        for (Py_ssize_t i = left; i < WIDTH; i++)
            LANE(inverse[a], i) = 0.0;
        scaled[a] = along * inverse[a];
        sums->form += along * scaled[a];
        weighted[0][a] = inverse[a];
        weighted[1][a] = inverse[a] * w;
        weighted[2][a] = weighted[1][a] * w;
        sums->same[a][a] -= inverse[a];
        sums->next[a][a] -= weighted[1][a];
    }
    for (int a = 0; a < b; a++)
        for (int d = a; d < b; d++) {
            Lanes pair = scaled[a] * scaled[d];
            sums->same[a][d] += pair;
            sums->next[a][d] += pair * w;
            for (int i = 0; curved && i < 3 * b; i++)
                sums->power[a][d][i / b][i % b] += pair * weighted[i / b][i % b];
        }
    for (int a = 0; curved && a < b; a++)
        for (int i = 0; i < 3 * b; i++)
            sums->trace[a][i / b][i % b] += inverse[a] * weighted[i / b][i % b];
}

/* Write the sums over a block, all modes of a row or a part of them, to those of the row. */
INLINE void add_to_row(const ModeSums *sums, Py_ssize_t added, int b, int curved, double *row)
{
    double *same = row + 3, *next = same + b * b, *power = next + b * b;
    double *trace = power + 3 * b * b * b;
    row[1] += sum_of_lanes(sums->form);
    for (int i = 0; i < WIDTH; i++)
        row[2] = LANE(sums->least, i) < row[2] ? LANE(sums->least, i) : row[2];
    for (int a = 0; a < b; a++) {
        row[0] += logarithm(&sums->variance[a], added);
        for (int d = 0; d < b; d++) {
            int low = a < d ? a : d, high = a < d ? d : a;
            same[a * b + d] += sum_of_lanes(sums->same[low][high]);
            next[a * b + d] += sum_of_lanes(sums->next[low][high]);
            for (int i = 0; curved && i < 3 * b; i++)
                power[(a * b + d) * 3 * b + i] +=
                    sum_of_lanes(sums->power[low][high][i / b][i % b]);
        }
        for (int i = 0; curved && i < 3 * b; i++)
            trace[a * 3 * b + i] += sum_of_lanes(sums->trace[a][i / b][i % b]);
    }
}

/* Sum the modes of all rows; the number of axes is a constant for the compiler. */
INLINE void sum_rows(const Modes *all, int b, int curved)
{
    for (Py_ssize_t row = 0; row < all->rows; row++) {
        double *out = all->sums + row * all->columns;
        memset(out, 0, (size_t)all->columns * sizeof(double));
        out[2] = DBL_MAX;
        for (Py_ssize_t start = 0; start < all->count; start += TRACK_BLOCK) {
            Py_ssize_t stop = start + TRACK_BLOCK;
            stop = stop < all->count ? stop : all->count;
            ModeSums sums;
            memset(&sums, 0, sizeof sums);
            sums.least = all_equal(DBL_MAX);
            for (int a = 0; a < b; a++)
                sums.variance[a].product = all_equal(1.0);
            for (Py_ssize_t k = start; k < stop; k += WIDTH)
                add_modes(all, row, k, stop - k, b, curved, &sums);
            add_to_row(&sums, (stop - start + WIDTH - 1) / WIDTH, b, curved, out);
        }
        if (out[1] != out[1]) /* no variance is the least where one is not a number */
            out[2] = out[1];
    }
}

EVERY_MACHINE
static void sum_modes(const Modes *modes)
{
    int curved = modes->columns > 3 + 2 * modes->b * modes->b;
    if (modes->b == 3 && curved)
        sum_rows(modes, 3, 1);
    else if (modes->b == 3)
        sum_rows(modes, 3, 0);
    else
        sum_rows(modes, (int)modes->b, curved);
}

/* Slopes (rows, m, b, b) of covariances, and sums over the modes in the axes (rows, b, b). */
typedef struct {
    Py_ssize_t rows, m, b;
    const double *axes, *same, *next, *power, *trace;
    double *slopes, *products, *out;
} Curvatures;

/* out = axes^T x axes for a symmetric x, (b, b) each. */
INLINE void turn_slope(const double *axes, const double *x, int b, double *out)
{
    for (int i = 0; i < b; i++)
        for (int j = i; j < b; j++) {
            double sum = 0.0;
            for (int c = 0; c < b; c++)
                for (int d = 0; d < b; d++)
                    sum += axes[c * b + i] * x[c * b + d] * axes[d * b + j];
            out[i * b + j] = out[j * b + i] = sum;
        }
}

/* The products of one pair of slopes with the sums, from which those with any other follow. */
INLINE void slope_products(const double *slope, const double *power, const double *trace, int b,
                           double *out)
{
    const double *same = slope, *next = slope + b * b;
    for (int c = 0; c < b; c++)
        for (int d = 0; d < b; d++)
            for (int k = 0; k < 2; k++) {
                const double *pair = trace + (c * 3 + k) * b + d;
                double sum = -0.5 * (pair[0] * same[c * b + d] + pair[b] * next[c * b + d]);
                for (int a = 0; a < b; a++) {
                    const double *three = power + ((a * b + d) * 3 + k) * b + c;
                    sum += three[0] * same[a * b + c] + three[b] * next[a * b + c];
                }
                out[(k * b + c) * b + d] = sum;
            }
}

INLINE void sum_curvatures(const Curvatures *all, int b)
{
    Py_ssize_t square = b * b, m = all->m;
    for (Py_ssize_t row = 0; row < all->rows; row++) {
        const double *axes = all->axes + row * square;
        for (Py_ssize_t i = 0; i < m; i++) {
            double *slope = all->slopes + 2 * i * square;
            turn_slope(axes, all->same + (row * m + i) * square, b, slope);
            turn_slope(axes, all->next + (row * m + i) * square, b, slope + square);
            slope_products(slope, all->power + row * 3 * square * b,
                           all->trace + row * 3 * square, b, all->products + 2 * i * square);
        }
        for (Py_ssize_t i = 0; i < m; i++)
            for (Py_ssize_t j = i; j < m; j++) {
                double sum = 0.0;
                for (int k = 0; k < 2 * b * b; k++)
                    sum += all->products[2 * i * square + k] * all->slopes[2 * j * square + k];
                all->out[(row * m + i) * m + j] = all->out[(row * m + j) * m + i] = sum;
            }
    }
}

EVERY_MACHINE
static void write_curvatures(const Curvatures *all)
{
    if (all->b == 3)
        sum_curvatures(all, 3);
    else
        sum_curvatures(all, (int)all->b);
}

/* Powers of the sine modes of `motions` tracks, (motions, count) each, at `points` places. */
typedef struct {
    Py_ssize_t points, motions, count;
    const double *power, *axes, *by_D, *by_theta, *given, *D, *theta;
    double *sums;
} Spectra;

enum { SPECTRUM_SUMS = 11 };

/* Add the sums of one block of modes of one track. */
INLINE void add_spectrum(const Spectra *all, Py_ssize_t first, Py_ssize_t count, double D,
                         double theta, double *sums)
{
    const double *axes = all->axes + first;
    Lanes zero = all_equal(0.0), least = all_equal(1e-100), part[SPECTRUM_SUMS];
    Logarithm log_variance = {all_equal(1.0), {0}};
    int alike = 1;
    for (int j = 0; j < SPECTRUM_SUMS; j++)
        part[j] = zero;
    for (Py_ssize_t k = 0; k < count; k++)
        alike &= axes[k] == axes[0];
    for (Py_ssize_t k = 0; k < count; k += WIDTH) {
        Py_ssize_t left = count - k, place = first + k;
        Lanes by_D = next_modes(all->by_D + place, left, 0.0);
        Lanes by_theta = next_modes(all->by_theta + place, left, 0.0);
        Lanes variance = by_D * D + by_theta * theta + next_modes(all->given + place, left, 1.0);
        variance = larger(least, variance); /* what is not a number remains none */
        if (alike)
            add_logarithm(&log_variance, variance);
        else
            for (int i = 0; i < WIDTH && i < left; i++)
                sums[0] += axes[k + i] * log(LANE(variance, i));
        Lanes inverse = 1 / variance;
        Lanes rise = next_modes(all->power + place, left, 0.0) * inverse;
        Lanes fall = next_modes(axes + k, left, 0.0) * inverse;
        part[0] += rise;
        rise *= inverse;
        part[1] += rise * by_D;
        part[2] += fall * by_D;
        part[3] += rise * by_theta;
        part[4] += fall * by_theta;
        rise *= inverse;
        fall *= inverse;
        Lanes squares[3] = {by_D * by_D, by_D * by_theta, by_theta * by_theta};
        for (int j = 0; j < 3; j++) {
            part[5 + j] += rise * squares[j];
            part[8 + j] += fall * squares[j];
        }
    }
    for (int j = 0; j < SPECTRUM_SUMS; j++)
        sums[j] += sum_of_lanes(part[j]);
    if (alike)
        sums[0] += axes[0] * logarithm(&log_variance, (count + WIDTH - 1) / WIDTH);
}

EVERY_MACHINE
static void sum_spectra(const Spectra *all)
{
    /* All points of one track after each other: its modes stay in the cache. */
    for (Py_ssize_t n = 0; n < all->points * all->motions; n++) {
        Py_ssize_t motion = n / all->points, i = n % all->points * all->motions + motion;
        double *sums = all->sums + i * SPECTRUM_SUMS;
        for (int j = 0; j < SPECTRUM_SUMS; j++)
            sums[j] = 0.0;
        for (Py_ssize_t start = 0; start < all->count; start += TRACK_BLOCK) {
            Py_ssize_t left = all->count - start, count = left < TRACK_BLOCK ? left : TRACK_BLOCK;
            add_spectrum(all, motion * all->count + start, count, all->D[i], all->theta[i], sums);
        }
        for (int j = 0; j < 5; j++)
            sums[j] *= j ? 0.5 : -0.5;
        for (int j = 5; j < SPECTRUM_SUMS; j++)
            sums[j] *= j < 8 ? -1.0 : -0.5;
    }
}

/* Steps (count, axes) of one motion, and the points at which two states of it are filtered.
 *
 * Axes with the same noise are a group; sizes (groups,) are their numbers of axes. noise (4, count,
 * groups) holds weight and known part of the frame before a step, then of that after it; clock (3,
 * count) duration, time since the step before, and whether a step follows it without a gap.
 */
typedef struct {
    Py_ssize_t points, count, axes, groups;
    const double *vectors, *noise, *clock, *sizes, *blur, *point;
    double *value, *pairs;
} States;

/* What is known of the noise of the last frame, for each state; a point in each lane. */
typedef struct {
    Lanes probability[2], mean[2][MOST_AXES], variance[2][MOST_AXES];
} Belief;

/* One step: variances and noises of the two states; a point in each lane. */
typedef struct {
    const double *y;
    Lanes spread[2], blur[2], noise[MOST_AXES];
} Step;

/* Densities of a step relative to the largest, by states before and after, and `inverse` variances.
 * The largest is the number that is returned times exp of minus `least`. */
INLINE Lanes densities(const States *states, const Step *step, const Belief *belief,
                       Lanes square[2][MOST_AXES], Lanes inverse[2][2][MOST_AXES],
                       Lanes density[2][2], Lanes *least)
{
    Lanes half_square[2][2], top = all_equal(0.0), tiny = all_equal(1e-100);
    *least = all_equal(DBL_MAX);
    for (int from = 0; from < 2; from++) {
        Py_ssize_t axis = 0;
        for (Py_ssize_t g = 0; g < states->groups; g++) {
            square[from][g] = all_equal(0.0);
            for (int i = 0; i < (int)states->sizes[g]; i++, axis++) {
                Lanes surprise = step->y[axis] + belief->mean[from][axis];
                square[from][g] += surprise * surprise;
            }
        }
        for (int to = 0; to < 2; to++) {
            Lanes sum_of_squares = all_equal(0.0), determinant = all_equal(1.0);
            for (Py_ssize_t g = 0; g < states->groups; g++) {
                Lanes sum = belief->variance[from][g] + (step->spread[to] + step->noise[g]);
                inverse[from][to][g] = 1 / choose(sum < tiny, tiny, sum);
                sum_of_squares += square[from][g] * inverse[from][to][g];
                for (int i = 0; i < (int)states->sizes[g]; i++)
                    determinant *= inverse[from][to][g];
            }
            half_square[from][to] = 0.5 * sum_of_squares;
            *least = choose(half_square[from][to] < *least, half_square[from][to], *least);
            density[from][to] = square_root(determinant);
        }
    }
    for (int i = 0; i < 4; i++) {
        density[i / 2][i % 2] *= exponential(*least - half_square[i / 2][i % 2]);
        top = larger(density[i / 2][i % 2], top);
    }
    Lanes scale = 1 / top;
    for (int i = 0; i < 4; i++)
        density[i / 2][i % 2] *= scale;
    return top;
}

/* Merge the noise of the last frame over the states before; `joint` has their weights. */
INLINE void merge(const States *states, const Step *step, Lanes joint[2][2],
                  Lanes square[2][MOST_AXES], Lanes inverse[2][2][MOST_AXES], Belief *belief)
{
    Belief next;
    for (int to = 0; to < 2; to++) {
        Lanes both = joint[0][to] + joint[1][to], weight = 1 / both;
        Py_ssize_t axis = 0;
        for (Py_ssize_t g = 0; g < states->groups; g++) {
            Lanes shared = step->noise[g] - step->blur[to], share[2], second = all_equal(0.0);
            for (int from = 0; from < 2; from++) {
                Lanes gain = shared * inverse[from][to][g];
                share[from] = joint[from][to] * weight * gain;
                second += share[from] * gain * square[from][g];
            }
            for (int i = 0; i < (int)states->sizes[g]; i++, axis++) {
                Lanes mean = share[0] * (step->y[axis] + belief->mean[0][axis]) +
                             share[1] * (step->y[axis] + belief->mean[1][axis]);
                next.mean[to][axis] = mean;
                second -= mean * mean;
            }
            next.variance[to][g] = step->noise[g] + 2 * step->blur[to] -
                                   shared * (share[0] + share[1]) + second / states->sizes[g];
        }
        next.probability[to] = both;
    }
    Lanes scale = 1 / (next.probability[0] + next.probability[1]);
    for (int to = 0; to < 2; to++)
        next.probability[to] *= scale;
    *belief = next;
}

/* Noise variance of the frame before (end 0) or after (end 1) step j. */
INLINE Lanes noise_of(const States *states, int end, Py_ssize_t j, Py_ssize_t g,
                      const Lanes point[5])
{
    Py_ssize_t place = j * states->groups + g, size = states->count * states->groups;
    const double *noise = states->noise + 2 * end * size;
    return point[4] * noise[place] + noise[size + place] - states->blur[1] * point[0];
}

/* Add a step, before which the state may have changed with probability `leaving`, to the belief, and
 * its density to the likelihood: two factors and `least`; `pairs` (2, 2) are written for the first
 * lane if they are given. */
INLINE void filter_step(const States *states, const Step *step, const Lanes leaving[2],
                        Belief *belief, Logarithm *density, Lanes *least, double *pairs)
{
    Lanes square[2][MOST_AXES], inverse[2][2][MOST_AXES], pair[2][2], smaller;
    Lanes top = densities(states, step, belief, square, inverse, pair, &smaller);
    Lanes sum = all_equal(0.0);
    for (int from = 0; from < 2; from++)
        for (int to = 0; to < 2; to++) {
            pair[from][to] *= from == to ? 1 - leaving[from] : leaving[from];
            if (pairs)
                pairs[2 * from + to] = LANE(pair[from][to], 0);
            pair[from][to] = belief->probability[from] * pair[from][to] + 1e-300;
        }
    for (int to = 0; to < 2; to++)
        sum += pair[0][to] + pair[1][to];
    add_logarithm(density, top);
    add_logarithm(density, sum);
    /* What is not a number has no logarithm, and is kept here. */
    *least += smaller + (sum - sum);
    merge(states, step, pair, square, inverse, belief);
}

/* Filter the WIDTH points from number p on; where points end, the last is repeated. */
INLINE void filter_points(const States *states, Py_ssize_t p)
{
    Py_ssize_t count = states->points - p < WIDTH ? states->points - p : WIDTH;
    double numbers[5][WIDTH];
    Lanes point[5];
    for (int lane = 0; lane < WIDTH; lane++)
        for (int k = 0; k < 5; k++)
            numbers[k][lane] = states->point[5 * (p + (lane < count ? lane : count - 1)) + k];
    memcpy(point, numbers, sizeof point);
    const Lanes *rate = point + 2;
    Lanes both = rate[0] + rate[1], leaving[2] = {rate[0], rate[1]};
    Logarithm density = {all_equal(1.0), {0}};
    Lanes least = all_equal(0.0);
    double elapsed = -1.0;
    Belief belief;
    Step step;
    for (int lane = 0; lane < count; lane++)
        states->value[p + lane] = 0.0;
    for (int k = 0; k < 2; k++) {
        step.blur[k] = states->blur[0] * point[k];
        belief.probability[k] = rate[1 - k] / both;
    }
    for (Py_ssize_t j = 0; j < states->count; j++) {
        const double *clock = states->clock + j;
        step.y = states->vectors + j * states->axes;
        for (int k = 0; k < 2; k++)
            step.spread[k] = 2 * point[k] * clock[0] - 4 * step.blur[k];
        if (!(clock[2 * states->count] > 0)) {
            for (int k = 0; k < 2; k++) {
                for (Py_ssize_t axis = 0; axis < states->axes; axis++)
                    belief.mean[k][axis] = all_equal(0.0);
                for (Py_ssize_t g = 0; g < states->groups; g++)
                    belief.variance[k][g] = noise_of(states, 0, j, g, point) + 2 * step.blur[k];
            }
        }
        for (Py_ssize_t g = 0; g < states->groups; g++)
            step.noise[g] = noise_of(states, 1, j, g, point);
        if (clock[states->count] != elapsed) {
            elapsed = clock[states->count];
            for (int lane = 0; lane < WIDTH; lane++) {
                double change = -expm1(-LANE(both, lane) * elapsed);
                for (int k = 0; k < 2; k++)
                    LANE(leaving[k], lane) = LANE(rate[k], lane) / LANE(both, lane) * change;
            }
        }
        filter_step(states, &step, leaving, &belief, &density, &least,
                    p == 0 ? states->pairs + 4 * j : NULL);
        Py_ssize_t added = 2 * (j % (TRACK_BLOCK / 2) + 1);
        if (added == TRACK_BLOCK || j + 1 == states->count) {
            for (int lane = 0; lane < count; lane++)
                states->value[p + lane] += lane_logarithm(&density, lane, added);
            density = (Logarithm){all_equal(1.0), {0}};
        }
    }
    for (int lane = 0; lane < count; lane++)
        states->value[p + lane] -= LANE(least, lane);
}

EVERY_MACHINE
static void filter_states(const States *states)
{
    for (Py_ssize_t p = 0; p < states->points; p += WIDTH)
        filter_points(states, p);
}

/* Keep `view` as doubles, C-contiguous; returns 0 with an exception set where it is not. */
static int doubles(PyObject *array, int flags, Py_buffer *view)
{
    if (PyObject_GetBuffer(array, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags) < 0)
        return 0;
    if (view->itemsize == sizeof(double) && view->format && strcmp(view->format, "d") == 0)
        return 1;
    PyBuffer_Release(view);
    PyErr_SetString(PyExc_TypeError, "expected arrays of float64");
    return 0;
}

/* Numbers from one row to the next: 0 where an array has one row for all; -1 if its size is wrong. */
static Py_ssize_t stride_of(const Py_buffer *view, Py_ssize_t rows, Py_ssize_t numbers)
{
    Py_ssize_t size = view->len / view->itemsize;
    if (size == rows * numbers)
        return numbers;
    return size == numbers ? 0 : -1;
}

static PyObject *solve_sets(Py_buffer views[4], const Py_buffer *weight)
{
    Sets sets = {.rows = views[3].len / views[3].itemsize, .n = 0};
    if (views[0].ndim < 2)
        return PyErr_Format(PyExc_ValueError, "expected points (rows, n, 3)");
    sets.n = views[0].shape[views[0].ndim - 2];
    sets.stride_y = stride_of(&views[0], sets.rows, 3 * sets.n);
    sets.stride_x = stride_of(&views[1], sets.rows, 3 * sets.n);
    sets.stride_w = weight ? stride_of(weight, sets.rows, sets.n) : 0;
    if (sets.n < 1 || sets.stride_y < 0 || sets.stride_x < 0 || sets.stride_w < 0 ||
        stride_of(&views[2], sets.rows, 9) < 0 || views[3].itemsize != 1)
        return PyErr_Format(PyExc_ValueError, "expected points (rows, n, 3), reference (rows or 1, "
                            "n, 3), rotation (rows, 3, 3), certain (rows,), weights (rows or 1, n)");
    sets.y = views[0].buf;
    sets.x = views[1].buf;
    sets.rotation = views[2].buf;
    sets.certain = views[3].buf;
    sets.w = weight ? weight->buf : NULL;
    /* Vectors need addresses that are multiples of their size. */
    size_t bytes = (size_t)(7 * sets.n) * sizeof(Lanes);
    char *memory = malloc(bytes + sizeof(Lanes));
    if (!memory)
        return PyErr_NoMemory();
    Lanes *lanes = (Lanes *)(memory + sizeof(Lanes) - (uintptr_t)memory % sizeof(Lanes));
    Py_BEGIN_ALLOW_THREADS
    solve(&sets, lanes, lanes + 3 * sets.n, lanes + 6 * sets.n);
    Py_END_ALLOW_THREADS
    free(memory);
    Py_RETURN_NONE;
}

static PyObject *wahba(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *arrays[5];
    if (!PyArg_ParseTuple(args, "OOOOO", arrays, arrays + 1, arrays + 2, arrays + 3, arrays + 4))
        return NULL;
    Py_buffer views[4], weight;
    int weighted = arrays[4] != Py_None, held = 0;
    PyObject *done = NULL;
    while (held < 3 && doubles(arrays[held], held == 2 ? PyBUF_WRITABLE : 0, &views[held]))
        held++;
    if (held == 3 && PyObject_GetBuffer(arrays[3], &views[3], PyBUF_CONTIG) == 0)
        held++;
    if (held == 4 && (!weighted || doubles(arrays[4], 0, &weight))) {
        done = solve_sets(views, weighted ? &weight : NULL);
        if (weighted)
            PyBuffer_Release(&weight);
    }
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    return done;
}

PyDoc_STRVAR(wahba_doc,
"wahba(points, reference, rotation, certain, weights)\n--\n\n"
"Write the rotations that carry reference sets onto points, and which of them are certain.\n\n"
"points (rows, n, 3), reference (rows or 1, n, 3) and weights (rows or 1, n) or None are read;\n"
"a point with a NaN is absent. rotation (rows, 3, 3) and certain (rows,) of bytes are written:\n"
"rows that are not certain have to be decided by a singular value decomposition.");

/* Whether the mask has `count` voxels: the images are written there and nowhere else. */
static int mask_fits(const Window *window)
{
    Py_ssize_t found = 0, size = window->shape[0] * window->shape[1] * window->shape[2];
    for (Py_ssize_t i = 0; i < size; i++)
        found += window->mask[i] != 0;
    return found == window->count;
}

static PyObject *write_spots(Py_buffer views[7])
{
    Py_buffer *mask = &views[0], *table = &views[5], *out = &views[6];
    Window window = {.mask = mask->buf, .center = views[1].buf, .voxel = views[2].buf,
                     .reach = views[3].buf, .spacing = views[4].buf, .table = table->buf,
                     .out = out->buf};
    int fits = mask->ndim == 3 && mask->itemsize == 1 && table->ndim == 3 && out->ndim == 3 &&
               out->shape[1] == 4 && table->shape[1] >= 4 && table->shape[2] >= 4;
    if (fits) {
        window.spheres = out->shape[0];
        window.count = out->shape[2];
        memcpy(window.shape, mask->shape, sizeof window.shape);
        memcpy(window.knots, table->shape + 1, sizeof window.knots);
        window.table_stride = table->shape[0] == 1 ? 0 : window.knots[0] * window.knots[1];
        fits = (table->shape[0] == 1 || table->shape[0] == window.spheres) &&
               views[1].len == window.spheres * 3 * (Py_ssize_t)sizeof(double) &&
               views[2].len == 3 * sizeof(double) && views[3].len == 3 * sizeof(double) &&
               views[4].len == 2 * sizeof(double) && mask_fits(&window);
    }
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "expected mask (nz, ny, nx), centers (n, 3), voxel "
                            "(3,), reach (3,), spacing (2,), tables (n or 1, a, b), out (n, 4, "
                            "voxels of the mask)");
    size_t pixels = (size_t)(window.shape[1] * window.shape[2]) * sizeof(Pixel);
    Pixel *memory = malloc(pixels + 2 * (size_t)window.knots[1] * sizeof(double));
    if (!memory)
        return PyErr_NoMemory();
    double *rows = (double *)((char *)memory + pixels);
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < window.spheres; i++)
        write_spot(&window, window.center + 3 * i, window.table + i * window.table_stride, memory,
                   rows, window.out + i * 4 * window.count);
    Py_END_ALLOW_THREADS
    free(memory);
    Py_RETURN_NONE;
}

static PyObject *spots(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *arrays[7];
    if (!PyArg_ParseTuple(args, "OOOOOOO", arrays, arrays + 1, arrays + 2, arrays + 3, arrays + 4,
                          arrays + 5, arrays + 6))
        return NULL;
    Py_buffer views[7];
    int held = PyObject_GetBuffer(arrays[0], &views[0], PyBUF_C_CONTIGUOUS) == 0;
    while (held > 0 && held < 7 &&
           doubles(arrays[held], held == 6 ? PyBUF_WRITABLE : 0, &views[held]))
        held++;
    PyObject *done = held == 7 ? write_spots(views) : NULL;
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    return done;
}

PyDoc_STRVAR(spots_doc,
"spots(mask, centers, voxel, reach, spacing, tables, out)\n--\n\n"
"Write the images of spheres, and their derivatives by z, y and x, on the voxels of a mask.\n\n"
"mask (nz, ny, nx) of bytes, centers (n, 3), voxel (3,) and reach (3,) in um, spacing (2,) of the\n"
"knots of tables (n or 1, a, b) are read, out (n, 4, voxels of the mask) is written.");

static PyObject *sum_mode_views(Py_buffer views[5])
{
    Py_buffer *sums = &views[4];
    Modes modes = {.modes = views[0].buf, .axes = views[1].buf, .share = views[2].buf,
                   .weight = views[3].buf, .sums = sums->buf};
    int fits = views[0].ndim == 3 && sums->ndim == 2 && views[0].shape[1] <= MOST_AXES;
    if (fits) {
        modes.rows = sums->shape[0];
        modes.columns = sums->shape[1];
        modes.b = views[0].shape[1];
        modes.count = views[0].shape[2];
        modes.stride = stride_of(&views[0], modes.rows, modes.count * modes.b);
        Py_ssize_t squares = modes.b * modes.b, fewer = 3 + 2 * squares;
        fits = modes.stride >= 0 && stride_of(&views[1], modes.rows, squares) > 0 &&
               stride_of(&views[2], modes.rows, modes.b) > 0 &&
               views[3].len == modes.count * (Py_ssize_t)sizeof(double) &&
               (modes.columns == fewer || modes.columns == fewer + 3 * squares * (modes.b + 1));
    }
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "expected modes (rows or 1, b, count), axes (rows, b, "
                            "b), share (rows, b), weight (count,), sums (rows, 3 + 2 b^2) or (rows, "
                            "3 + 5 b^2 + 3 b^3), b up to 3");
    Py_BEGIN_ALLOW_THREADS
    sum_modes(&modes);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

enum { MOST_ARRAYS = 16 };

/* Call a function with `count` arrays of doubles, the last of which, `written`, it writes. */
static PyObject *with_doubles(PyObject *args, int count, int written,
                              PyObject *(*work)(Py_buffer *))
{
    Py_buffer views[MOST_ARRAYS];
    int held = 0;
    if (PyTuple_Size(args) != count)
        return PyErr_Format(PyExc_TypeError, "expected %d arrays", count);
    while (held < count && doubles(PyTuple_GetItem(args, held),
                                   held >= count - written ? PyBUF_WRITABLE : 0, &views[held]))
        held++;
    PyObject *done = held == count ? work(views) : NULL;
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    return done;
}

static PyObject *mode_sums(PyObject *self, PyObject *args)
{
    (void)self;
    return with_doubles(args, 5, 1, sum_mode_views);
}

PyDoc_STRVAR(mode_sums_doc,
"mode_sums(modes, axes, share, weight, sums)\n--\n\n"
"Write what a likelihood of modes and its derivatives need, in axes where the modes are independent.\n\n"
"modes (rows or 1, b, count), axes (rows, b, b), share (rows, b) and weight (count,) are read; sums\n"
"(rows, 3 + 2 b^2), or with second derivatives (rows, 3 + 5 b^2 + 3 b^3), is written.");

static PyObject *sum_spectrum_views(Py_buffer views[8])
{
    Py_buffer *sums = &views[7];
    Spectra all = {.power = views[0].buf, .axes = views[1].buf, .by_D = views[2].buf,
                   .by_theta = views[3].buf, .given = views[4].buf, .D = views[5].buf,
                   .theta = views[6].buf, .sums = sums->buf};
    int fits = views[0].ndim == 2 && sums->ndim == 3 && sums->shape[2] == SPECTRUM_SUMS;
    if (fits) {
        all.motions = views[0].shape[0];
        all.count = views[0].shape[1];
        all.points = sums->shape[0];
        fits = sums->shape[1] == all.motions;
        for (int i = 1; i < 5; i++)
            fits &= views[i].len == views[0].len;
        for (int i = 5; i < 7; i++)
            fits &= views[i].len == all.points * all.motions * (Py_ssize_t)sizeof(double);
    }
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "expected power, axes, by_D, by_theta and given "
                            "(motions, count), D and theta (points, motions), sums (points, "
                            "motions, 11)");
    Py_BEGIN_ALLOW_THREADS
    sum_spectra(&all);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *spectrum_sums(PyObject *self, PyObject *args)
{
    (void)self;
    return with_doubles(args, 8, 1, sum_spectrum_views);
}

PyDoc_STRVAR(spectrum_sums_doc,
"spectrum_sums(power, axes, by_D, by_theta, given, D, theta, sums)\n--\n\n"
"Write the log-likelihoods of sine modes, and the positive and negative parts of their slopes.\n\n"
"power, axes, by_D, by_theta and given (motions, count), D and theta (points, motions) are read,\n"
"sums (points, motions, 11) is written.");

static PyObject *filter_state_views(Py_buffer views[8])
{
    Py_ssize_t size = sizeof(double);
    States states = {.vectors = views[0].buf, .noise = views[1].buf, .clock = views[2].buf,
                     .sizes = views[3].buf, .blur = views[4].buf, .point = views[5].buf,
                     .pairs = views[6].buf, .value = views[7].buf};
    int fits = views[0].ndim == 2 && views[0].shape[1] <= MOST_AXES;
    if (fits) {
        double axes = 0.0;
        states.count = views[0].shape[0];
        states.axes = views[0].shape[1];
        states.groups = views[3].len / size;
        states.points = views[7].len / size;
        for (Py_ssize_t g = 0; g < states.groups; g++)
            axes += states.sizes[g] >= 1 ? floor(states.sizes[g]) : MOST_AXES + 1;
        fits = axes == (double)states.axes &&
               views[1].len == 4 * states.count * states.groups * size &&
               views[2].len == 3 * states.count * size && views[4].len == 2 * size &&
               views[5].len == 5 * states.points * size && views[6].len == 4 * states.count * size;
    }
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "expected vectors (count, axes), noise (4, count, "
                            "groups), clock (3, count), sizes (groups,), blur (2,), points (P, 5), "
                            "pairs (count, 2, 2), value (P,), up to 3 axes");
    Py_BEGIN_ALLOW_THREADS
    filter_states(&states);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *two_states(PyObject *self, PyObject *args)
{
    (void)self;
    return with_doubles(args, 8, 2, filter_state_views);
}

PyDoc_STRVAR(two_states_doc,
"two_states(vectors, noise, clock, sizes, blur, points, pairs, value)\n--\n\n"
"Write the log-likelihoods of two states at some points, and the weights of pairs at the first.\n\n"
"vectors (count, axes) in the order of their groups, noise (4, count, groups), clock (3, count),\n"
"sizes (groups,), blur (2,) and points (P, 5) are read; pairs (count, 2, 2) and value (P,) are\n"
"written.");

static PyObject *curvature_views(Py_buffer views[6])
{
    Curvatures all = {.axes = views[0].buf, .same = views[1].buf, .next = views[2].buf,
                      .power = views[3].buf, .trace = views[4].buf, .out = views[5].buf};
    Py_ssize_t size = sizeof(double);
    int fits = views[1].ndim == 4 && views[1].shape[3] <= MOST_AXES;
    if (fits) {
        all.rows = views[1].shape[0];
        all.m = views[1].shape[1];
        all.b = views[1].shape[3];
        Py_ssize_t square = all.b * all.b * all.rows * size;
        fits = views[0].len == square && views[1].len == all.m * square &&
               views[2].len == views[1].len && views[3].len == 3 * all.b * square &&
               views[4].len == 3 * square && views[5].len == all.rows * all.m * all.m * size;
    }
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "expected axes (rows, b, b), same and next (rows, m, "
                            "b, b), power (rows, b, b, 3, b), trace (rows, b, 3, b), out (rows, m, "
                            "m), b up to 3");
    size_t numbers = (size_t)(2 * all.b * all.b * all.m);
    all.slopes = malloc(2 * numbers * sizeof(double) + 1);
    if (!all.slopes)
        return PyErr_NoMemory();
    all.products = all.slopes + numbers;
    Py_BEGIN_ALLOW_THREADS
    write_curvatures(&all);
    Py_END_ALLOW_THREADS
    free(all.slopes);
    Py_RETURN_NONE;
}

static PyObject *curvatures(PyObject *self, PyObject *args)
{
    (void)self;
    return with_doubles(args, 6, 1, curvature_views);
}

PyDoc_STRVAR(curvatures_doc,
"curvatures(axes, same, next, power, trace, out)\n--\n\n"
"Write minus the second derivatives of a likelihood along slopes of the covariances of its modes.\n\n"
"axes (rows, b, b), symmetric slopes same and next (rows, m, b, b), power (rows, b, b, 3, b) and\n"
"trace (rows, b, 3, b) are read, out (rows, m, m) is written.");

static PyMethodDef functions[] = {
    {"wahba", wahba, METH_VARARGS, wahba_doc},
    {"spots", spots, METH_VARARGS, spots_doc},
    {"curvatures", curvatures, METH_VARARGS, curvatures_doc},
    {"mode_sums", mode_sums, METH_VARARGS, mode_sums_doc},
    {"two_states", two_states, METH_VARARGS, two_states_doc},
    {"spectrum_sums", spectrum_sums, METH_VARARGS, spectrum_sums_doc},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "kernels", "Compiled twins of functions of perrin.", 0,
    functions, slots, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit_kernels(void) { return PyModuleDef_Init(&module); }
