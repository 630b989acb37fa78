/* How fast one contour iteration can be: for comparison only, not a part of fingerpost.
 *
 * 100 normals x 41 samples (+-20 px) of a u8 image, 7-tap derivative of Gaussian, signed argmax,
 * parabola to sub-pixel, Huber weight, 6-dof affine normal equations, Cholesky, update. Four ways
 * to do the sampling:
 *   scalar  plain C, float bilinear, one normal at a time (what one writes first)
 *   gather  lane = normal, AVX-512 32-bit gathers, float bilinear
 *   fixed   lane = normal, scalar 16-bit pair loads + int16 vector bilinear
 *   nn      lane = normal, nearest pixel, one byte load per sample (lower bound)
 *
 *   cargo bench --bench ratios   writes DATA_DIR and does the rest
 *   gcc -O3 -ffast-math -DLB=16 -march=native limit.c -o limit -lm
 *   taskset -c 1 ./limit DATA_DIR NAME [rounds]     NAME is finger_vga or finger_hd
 *
 * The unit of fingerpost's speed ratios is "copied_us" of "limit_fixed", timed in the same run on
 * the same pinned core. States of the image: hot (same frame again and again), copied (frame just
 * written by memcpy, as a decoder leaves it; the copy is not timed), rotate64 (64 different frames,
 * one iteration each), flushed (clflush before each). frame4 is a frame of 4 iterations.
 * x86-64 only.
 */
#define _GNU_SOURCE
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <math.h>
#include <time.h>
#include <immintrin.h>

#define N 100
#ifndef L
#define L 20
#endif
#define K (2 * L + 1)
#define R (K - 6)
#ifndef LB
#define LB 32
#endif
#define NP (((N + 31) / 32) * 32)
#define AL __attribute__((aligned(64)))

static const float T1 = 48 / 200.f, T2 = 39 / 200.f, T3 = 13 / 200.f;
#define HUBER 4.0f
#define SC 0.01f

typedef struct { AL float x[NP], y[NP], tx[NP], ty[NP]; } Tmpl;   /* points, tangents */
typedef struct { const uint8_t *p; int w, h, s; } Img;
typedef struct { AL float px[NP], py[NP], nx[NP], ny[NP], d[NP], w[NP]; } Meas;

static double now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec * 1e6 + t.tv_nsec * 1e-3; }

/* contour points and outward unit normals; points whose search line leaves the image get w=0 */
static void place(const Tmpl *t, const float *a, const Img *im, Meas *m) {
  float sg = a[0] * a[3] - a[1] * a[2] < 0 ? -1.f : 1.f;
  float lo = L + 2, hx = im->w - L - 3, hy = im->h - L - 3;
  for (int i = 0; i < NP; i++) {
    float px = a[0] * t->x[i] + a[1] * t->y[i] + a[4], py = a[2] * t->x[i] + a[3] * t->y[i] + a[5];
    float ux = a[0] * t->tx[i] + a[1] * t->ty[i], uy = a[2] * t->tx[i] + a[3] * t->ty[i];
    float q = sg / sqrtf(ux * ux + uy * uy + 1e-20f);
    int ok = (px > lo) & (px < hx) & (py > lo) & (py < hy);
    m->w[i] = ok ? 1.f : 0.f;
    m->px[i] = ok ? px : lo + 1; m->py[i] = ok ? py : lo + 1;
    m->nx[i] = -uy * q; m->ny[i] = ux * q;
  }
}

/* Huber weight, normal equations, Cholesky, update */
static void solve(const Tmpl *t, Meas *m, float *a) {
  float S[27]; memset(S, 0, sizeof S);
  float s00=0,s01=0,s02=0,s11=0,s12=0,s22=0;       /* sums of nxnx * {xx xy x yy y 1} */
  float u00=0,u01=0,u02=0,u11=0,u12=0,u22=0;       /* nxny */
  float v00=0,v01=0,v02=0,v11=0,v12=0,v22=0;       /* nyny */
  float bx0=0,bx1=0,bx2=0,by0=0,by1=0,by2=0;
  for (int i = 0; i < NP; i++) {
    float d = m->d[i], ad = fabsf(d), w = m->w[i] * (ad > HUBER ? HUBER / ad : 1.f);
    float x = t->x[i] * SC, y = t->y[i] * SC, nx = m->nx[i], ny = m->ny[i];
    float xx = w * x * x, xy = w * x * y, yy = w * y * y, wx = w * x, wy = w * y;
    float a2 = nx * nx, ab = nx * ny, b2 = ny * ny;
    s00 += a2 * xx; s01 += a2 * xy; s02 += a2 * wx; s11 += a2 * yy; s12 += a2 * wy; s22 += a2 * w;
    u00 += ab * xx; u01 += ab * xy; u02 += ab * wx; u11 += ab * yy; u12 += ab * wy; u22 += ab * w;
    v00 += b2 * xx; v01 += b2 * xy; v02 += b2 * wx; v11 += b2 * yy; v12 += b2 * wy; v22 += b2 * w;
    float dx = d * nx, dy = d * ny;
    bx0 += wx * dx; bx1 += wy * dx; bx2 += w * dx; by0 += wx * dy; by1 += wy * dy; by2 += w * dy;
  }
  (void)S;
  float H[6][6] = {
    {s00,s01,s02,u00,u01,u02},{s01,s11,s12,u01,u11,u12},{s02,s12,s22,u02,u12,u22},
    {u00,u01,u02,v00,v01,v02},{u01,u11,u12,v01,v11,v12},{u02,u12,u22,v02,v12,v22}};
  float b[6] = {bx0,bx1,bx2,by0,by1,by2}, l[6][6];
  for (int i = 0; i < 6; i++) H[i][i] += 1e-4f;
  for (int j = 0; j < 6; j++) {
    float s = H[j][j]; for (int k = 0; k < j; k++) s -= l[j][k] * l[j][k];
    if (!(s > 1e-9f)) return;
    float q = 1 / sqrtf(s); l[j][j] = q;
    for (int i = j + 1; i < 6; i++) { float r = H[i][j]; for (int k = 0; k < j; k++) r -= l[i][k] * l[j][k]; l[i][j] = r * q; }
  }
  for (int i = 0; i < 6; i++) { for (int k = 0; k < i; k++) b[i] -= l[i][k] * b[k]; b[i] *= l[i][i]; }
  for (int i = 5; i >= 0; i--) { for (int k = i + 1; k < 6; k++) b[i] -= l[k][i] * b[k]; b[i] *= l[i][i]; }
  a[0] += b[0] * SC; a[1] += b[1] * SC; a[4] += b[2]; a[2] += b[3] * SC; a[3] += b[4] * SC; a[5] += b[5];
}

static float parab(float l, float c, float r) { float q = l - 2 * c + r; return q < -1e-6f ? .5f * (l - r) / q : 0.f; }

/* ---- scalar ---- */
static void it_scalar(const Tmpl *t, const Img *im, float *a, Meas *m) {
  place(t, a, im, m);
  for (int i = 0; i < N; i++) {
    float v[K], r[R]; m->d[i] = 0;
    if (m->w[i] == 0) continue;
    for (int k = 0; k < K; k++) {
      float x = m->px[i] + (k - L) * m->nx[i], y = m->py[i] + (k - L) * m->ny[i];
      int ix = (int)x, iy = (int)y; float fx = x - ix, fy = y - iy;
      const uint8_t *p = im->p + iy * im->s + ix;
      v[k] = (1 - fy) * ((1 - fx) * p[0] + fx * p[1]) + fy * ((1 - fx) * p[im->s] + fx * p[im->s + 1]);
    }
    int bk = 0; float b = -1e9f;
    for (int k = 0; k < R; k++) {
      r[k] = T1 * (v[k + 2] - v[k + 4]) + T2 * (v[k + 1] - v[k + 5]) + T3 * (v[k] - v[k + 6]);
      if (r[k] > b) b = r[k], bk = k;
    }
    if (b < 4) { m->w[i] = 0; continue; }
    m->d[i] = bk + 3 - L + (bk > 0 && bk < R - 1 ? parab(r[bk - 1], r[bk], r[bk + 1]) : 0);
  }
  for (int i = N; i < NP; i++) m->w[i] = 0, m->d[i] = 0;
  solve(t, m, a);
}

/* ---- gather ---- */
#ifdef __AVX512BW__
static void it_gather(const Tmpl *t, const Img *im, float *a, Meas *m) {
  place(t, a, im, m);
  AL float r[R][16];
  for (int o = 0; o < 112; o += 16) {
    __m512 px = _mm512_load_ps(m->px + o), py = _mm512_load_ps(m->py + o), nx = _mm512_load_ps(m->nx + o), ny = _mm512_load_ps(m->ny + o);
    __m512 v[7] = {0}, best = _mm512_set1_ps(-1e9f), bk = _mm512_setzero_ps();
    __m512i st = _mm512_set1_epi32(im->s), m8 = _mm512_set1_epi32(255);
    for (int k = 0; k < K; k++) {
      __m512 c = _mm512_set1_ps(k - L), x = _mm512_fmadd_ps(c, nx, px), y = _mm512_fmadd_ps(c, ny, py);
      __m512i ix = _mm512_cvttps_epi32(x), iy = _mm512_cvttps_epi32(y);
      __m512 fx = _mm512_sub_ps(x, _mm512_cvtepi32_ps(ix)), fy = _mm512_sub_ps(y, _mm512_cvtepi32_ps(iy));
      __m512i of = _mm512_add_epi32(_mm512_mullo_epi32(iy, st), ix);
      __m512i g0 = _mm512_i32gather_epi32(of, im->p, 1), g1 = _mm512_i32gather_epi32(of, im->p + im->s, 1);
      __m512 p00 = _mm512_cvtepi32_ps(_mm512_and_si512(g0, m8)), p01 = _mm512_cvtepi32_ps(_mm512_and_si512(_mm512_srli_epi32(g0, 8), m8));
      __m512 p10 = _mm512_cvtepi32_ps(_mm512_and_si512(g1, m8)), p11 = _mm512_cvtepi32_ps(_mm512_and_si512(_mm512_srli_epi32(g1, 8), m8));
      __m512 t0 = _mm512_fmadd_ps(fx, _mm512_sub_ps(p01, p00), p00), t1 = _mm512_fmadd_ps(fx, _mm512_sub_ps(p11, p10), p10);
      for (int q = 0; q < 6; q++) v[q] = v[q + 1];
      v[6] = _mm512_fmadd_ps(fy, _mm512_sub_ps(t1, t0), t0);
      if (k >= 6) {
        __m512 e = _mm512_mul_ps(_mm512_set1_ps(T1), _mm512_sub_ps(v[2], v[4]));
        e = _mm512_fmadd_ps(_mm512_set1_ps(T2), _mm512_sub_ps(v[1], v[5]), e);
        e = _mm512_fmadd_ps(_mm512_set1_ps(T3), _mm512_sub_ps(v[0], v[6]), e);
        _mm512_store_ps(r[k - 6], e);
        __mmask16 g = _mm512_cmp_ps_mask(e, best, _CMP_GT_OQ);
        best = _mm512_mask_mov_ps(best, g, e);
        bk = _mm512_mask_mov_ps(bk, g, _mm512_set1_ps(k - 6));
      }
    }
    AL float B[16], Kk[16]; _mm512_store_ps(B, best); _mm512_store_ps(Kk, bk);
    for (int j = 0; j < 16; j++) {
      int b = (int)Kk[j], i = o + j;
      int lo = b > 0 ? b - 1 : 0, hi = b < R - 1 ? b + 1 : R - 1;
      if (i >= N || B[j] < 4) m->w[i] = 0;
      m->d[i] = b + 3 - L + parab(r[lo][j], r[b][j], r[hi][j]);
    }
  }
  for (int i = 112; i < NP; i++) m->w[i] = 0, m->d[i] = 0;
  solve(t, m, a);
}
#endif

/* ---- fixed point, scalar pair loads, int16 lanes ---- */
static inline void dog_i16(int16_t (*v)[LB], Meas *m, int o) {
  AL int16_t r[R][LB], best[LB], bk[LB];
  for (int j = 0; j < LB; j++) best[j] = -32768, bk[j] = 0;
  for (int k = 0; k < R; k++) {
    for (int j = 0; j < LB; j++) {
      int16_t d1 = v[k + 2][j] - v[k + 4][j], d2 = v[k + 1][j] - v[k + 5][j], d3 = v[k][j] - v[k + 6][j];
      int16_t e = (int16_t)(((int)d1 * 15729) >> 16) + (int16_t)(((int)d2 * 12780) >> 16) + (int16_t)(((int)d3 * 4260) >> 16);
      r[k][j] = e;
      int16_t g = -(e > best[j]);
      best[j] = e > best[j] ? e : best[j];
      bk[j] = (bk[j] & ~g) | (g & (int16_t)k);
    }
  }
  for (int j = 0; j < LB; j++) {
    int b = bk[j], i = o + j, lo = b > 0 ? b - 1 : 0, hi = b < R - 1 ? b + 1 : R - 1;
    if (i >= N || best[j] < 4 * 128) m->w[i] = 0;
    m->d[i] = b + 3 - L + parab(r[lo][j], r[b][j], r[hi][j]);
  }
}

static void it_fixed(const Tmpl *t, const Img *im, float *a, Meas *m) {
  place(t, a, im, m);
  AL int32_t off[K][LB]; AL uint16_t top[K][LB], bot[K][LB], fx[K][LB], fy[K][LB]; AL int16_t v[K][LB];
  const uint8_t *p0 = im->p, *p1 = im->p + im->s; const int s = im->s;
  for (int o = 0; o < N; o += LB) {
    AL int32_t x0[LB], y0[LB], dx[LB], dy[LB];
    for (int j = 0; j < LB; j++) {
      dx[j] = (int32_t)(m->nx[o + j] * 65536.f); dy[j] = (int32_t)(m->ny[o + j] * 65536.f);
      x0[j] = (int32_t)(m->px[o + j] * 65536.f) - L * dx[j]; y0[j] = (int32_t)(m->py[o + j] * 65536.f) - L * dy[j];
    }
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) {
        int32_t x = x0[j] + k * dx[j], y = y0[j] + k * dy[j];
        off[k][j] = (y >> 16) * s + (x >> 16);
        fx[k][j] = (x >> 9) & 127; fy[k][j] = (y >> 9) & 127;
      }
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) {
        int32_t q = off[k][j]; uint16_t u, w; memcpy(&u, p0 + q, 2); memcpy(&w, p1 + q, 2);
        top[k][j] = u; bot[k][j] = w;
      }
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) {
        uint16_t X = fx[k][j], Y = fy[k][j], u = top[k][j], w = bot[k][j];
        uint16_t ht = (uint16_t)((u & 255) * (128 - X) + (u >> 8) * X), hb = (uint16_t)((w & 255) * (128 - X) + (w >> 8) * X);
        v[k][j] = (int16_t)((uint16_t)(((uint32_t)ht * (uint16_t)((128 - Y) << 8)) >> 16) + (uint16_t)(((uint32_t)hb * (uint16_t)(Y << 8)) >> 16)) << 1;
      }
    dog_i16(v, m, o);
  }
  for (int i = ((N + LB - 1) / LB) * LB; i < NP; i++) m->w[i] = 0, m->d[i] = 0;
  solve(t, m, a);
}

static void it_nn(const Tmpl *t, const Img *im, float *a, Meas *m) {
  place(t, a, im, m);
  AL int32_t off[K][LB]; AL uint8_t u8[K][LB]; AL int16_t v[K][LB];
  const uint8_t *p0 = im->p; const int s = im->s;
  for (int o = 0; o < N; o += LB) {
    AL int32_t x0[LB], y0[LB], dx[LB], dy[LB];
    for (int j = 0; j < LB; j++) {
      dx[j] = (int32_t)(m->nx[o + j] * 65536.f); dy[j] = (int32_t)(m->ny[o + j] * 65536.f);
      x0[j] = (int32_t)(m->px[o + j] * 65536.f) - L * dx[j] + 32768; y0[j] = (int32_t)(m->py[o + j] * 65536.f) - L * dy[j] + 32768;
    }
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) {
        int32_t x = x0[j] + k * dx[j], y = y0[j] + k * dy[j];
        off[k][j] = (y >> 16) * s + (x >> 16);
      }
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) u8[k][j] = p0[off[k][j]];
    for (int k = 0; k < K; k++)
      for (int j = 0; j < LB; j++) v[k][j] = u8[k][j] << 7;
    dog_i16(v, m, o);
  }
  for (int i = ((N + LB - 1) / LB) * LB; i < NP; i++) m->w[i] = 0, m->d[i] = 0;
  solve(t, m, a);
}

typedef void (*Iter)(const Tmpl *, const Img *, float *, Meas *);
static int cmp(const void *a, const void *b) { double x = *(double *)a, y = *(double *)b; return x < y ? -1 : x > y; }
static double med(double *v, int n) { qsort(v, n, 8, cmp); return v[n / 2]; }

static char *rd(const char *d, const char *n, const char *e, size_t *len) {
  char p[1024]; snprintf(p, sizeof p, "%s/%s.%s", d, n, e); FILE *f = fopen(p, "rb"); if (!f) { perror(p); exit(1); }
  fseek(f, 0, SEEK_END); size_t l = ftell(f); rewind(f); char *b = aligned_alloc(64, (l + 4159) / 64 * 64);
  if (fread(b, 1, l, f) != l) exit(1);
  fclose(f); if (len) *len = l; return b;
}

int main(int c, char **v) {
  if (c < 3) { fprintf(stderr, "usage: limit DATA_DIR NAME [rounds]\n"); return 2; }
  const char *dir = v[1], *name = v[2]; int rounds = c > 3 ? atoi(v[3]) : 5;
  char *tx = rd(dir, name, "txt", 0); int nf, h, w, np; double rad, hl; sscanf(tx, "%d %d %d %d %lf %lf", &nf, &h, &w, &np, &rad, &hl);
  uint8_t *fr = (uint8_t *)rd(dir, name, "u8", 0); double *T = (double *)rd(dir, name, "truth", 0), *P = (double *)rd(dir, name, "tmpl", 0);
  static Tmpl t; static Meas m;
  for (int i = 0; i < NP; i++) { int j = i < N ? i : 0; t.x[i] = P[4 * j]; t.y[i] = P[4 * j + 1]; t.tx[i] = P[4 * j + 3]; t.ty[i] = -P[4 * j + 2]; }
  size_t fs = (size_t)w * h; uint8_t *buf = aligned_alloc(64, fs + 4096);
  struct { const char *n; Iter f; } V[] = { {"scalar", it_scalar},
#ifdef __AVX512BW__
    {"gather", it_gather},
#endif
    {"fixed", it_fixed}, {"nn", it_nn} };
  int nv = sizeof V / sizeof *V;
  for (int q = 0; q < nv; q++) {
    /* accuracy: 4 iterations a frame, from the previous frame's state */
    float a[6]; for (int i = 0; i < 6; i++) a[i] = T[i];
    double se = 0, worst = 0; long ne = 0; double tf[4096]; int ntf = 0;
    for (int r = 0; r < 2; r++) for (int f = 0; f < nf; f++) {
      int g = nf == 256 ? f : (r ? nf - 1 - f : f);
      memcpy(buf, fr + g * fs, fs); Img im = {buf, w, h, w};
      double t0 = now(); for (int k = 0; k < 4; k++) V[q].f(&t, &im, a, &m); double t1 = now();
      if (ntf < 4096) tf[ntf++] = t1 - t0;
      const double *A = T + 6 * g;                         /* contour error along the true normal */
      double s = 0; for (int i = 0; i < N; i++) {
        double ex = (a[0] - A[0]) * t.x[i] + (a[1] - A[1]) * t.y[i] + a[4] - A[4], ey = (a[2] - A[2]) * t.x[i] + (a[3] - A[3]) * t.y[i] + a[5] - A[5];
        double ux = A[0] * t.tx[i] + A[1] * t.ty[i], uy = A[2] * t.tx[i] + A[3] * t.ty[i], d = (-uy * ex + ux * ey) / hypot(ux, uy);
        s += d * d; }
      s /= N; se += s; ne++; if (sqrt(s) > worst) worst = sqrt(s);
    }
    double frame4 = med(tf, ntf);
    /* time of one iteration, in each state of the image */
    double mh[64], mc[64], mr[64], mf[64]; if (rounds > 64) rounds = 64;
    for (int r = 0; r < rounds; r++) {
      double b[512]; float s0[6];
      const uint8_t *f0 = fr; Img im = {f0, w, h, w}; for (int i = 0; i < 6; i++) s0[i] = T[i];
      for (int i = 0; i < 400; i++) { memcpy(a, s0, 24); double t0 = now(); for (int z = 0; z < 10; z++) { memcpy(a, s0, 24); V[q].f(&t, &im, a, &m); } b[i] = (now() - t0) / 10; }
      mh[r] = med(b, 400);
      for (int i = 0; i < 256; i++) { int g = i % nf; memcpy(buf, fr + g * fs, fs); Img e = {buf, w, h, w}; for (int z = 0; z < 6; z++) a[z] = T[6 * g + z];
        double t0 = now(); V[q].f(&t, &e, a, &m); b[i] = now() - t0; }
      mc[r] = med(b, 256);
      for (int i = 0; i < 256; i++) { int g = i % 64; Img e = {fr + g * fs, w, h, w}; for (int z = 0; z < 6; z++) a[z] = T[6 * g + z];
        double t0 = now(); V[q].f(&t, &e, a, &m); b[i] = now() - t0; }
      mr[r] = med(b, 256);
      for (int i = 0; i < 100; i++) { int g = i % nf; Img e = {fr + g * fs, w, h, w}; for (int z = 0; z < 6; z++) a[z] = T[6 * g + z];
        for (size_t z = 0; z < fs; z += 64) _mm_clflush(fr + g * fs + z);
        _mm_mfence();
        double t0 = now(); V[q].f(&t, &e, a, &m); b[i] = now() - t0; }
      mf[r] = med(b, 100);
    }
    printf("{\"peer\":\"limit_%s\",\"name\":\"%s\",\"hot_us\":%.2f,\"copied_us\":%.2f,\"rotate64_us\":%.2f,\"flushed_us\":%.2f,\"frame4_us\":%.2f,\"rms_px\":%.4f,\"worst_frame_px\":%.4f}\n",
      V[q].n, name, med(mh, rounds), med(mc, rounds), med(mr, rounds), med(mf, rounds), frame4, sqrt(se / ne), worst);
    fflush(stdout);
  }
  double e0[1001]; for (int i = 0; i < 1001; i++) { double t0 = now(); e0[i] = now() - t0; }
  printf("{\"peer\":\"clock\",\"us\":%.3f}\n", med(e0, 1001));
  return 0;
}
