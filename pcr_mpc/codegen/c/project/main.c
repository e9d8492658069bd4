/* Closes the loop of the scene with the generated plant, and holds it against the run that Python recorded. */
#define _POSIX_C_SOURCE 199309L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "pcr.h"
#include "pcr_vectors.h"

static pcr_controller controller;
static pcr_plant plant;

/* When something began, and then how long it took: CPU time and wall time [us]. */
typedef struct {
    double cpu, wall;
} took;

static double now_us(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

static took begin(void)
{
    took now;
    now.cpu = now_us(CLOCK_THREAD_CPUTIME_ID);
    now.wall = now_us(CLOCK_MONOTONIC);
    return now;
}

static took end(took began)
{
    took since;
    since.wall = now_us(CLOCK_MONOTONIC) - began.wall;
    since.cpu = now_us(CLOCK_THREAD_CPUTIME_ID) - began.cpu;
    return since;
}

static int by_size(const void *a, const void *b)
{
    const double x = ((const took *)a)->cpu, y = ((const took *)b)->cpu;
    return (x > y) - (x < y);
}

static void show(const char *name, took *times, int count)
{
    static const double shares[] = {0.5, 0.95, 0.99, 0.999, 1.0};
    qsort(times, (size_t)count, sizeof *times, by_size);
    printf("%-14s", name);
    for (int i = 0; i < 5; i++) {
        printf("%10.2f", times[(int)(shares[i] * (count - 1))].cpu);
    }
    printf("%10d\n", count);
}

/* Tip of the plant at all its steps so far, of which pictures are taken. */
static pcr_real tips[PCR_PERIODS * PCR_STEPS_A_PERIOD + 1][2];

static void look(int step)
{
    memcpy(tips[step], plant.x, sizeof tips[step]);
}

/* Tip of the picture that has come after so many steps. */
static void picture(int step, pcr_real *p)
{
    const double at = fmax(step - PCR_PICTURE_AGE, 0.0);
    const int before = (int)at, after = before + 1 < step ? before + 1 : step;
    for (int i = 0; i < 2; i++) {
        p[i] = tips[before][i] + (at - before) * (tips[after][i] - tips[before][i]);
    }
}

/* What the sensors say of the plant in period k; noise is that of the recorded run. */
static void measure(int k, pcr_measurement *measured)
{
    memset(measured, 0, sizeof *measured);
    picture(k * PCR_STEPS_A_PERIOD, measured->p);
    memcpy(measured->v, plant.x + 2, sizeof measured->v);
    pcr_plant_angles(&plant, measured->q);
    for (int i = 0; i < 2; i++) {
        measured->p[i] = pcr_vector_seen[k] ? measured->p[i] + pcr_vector_noise[k][i] : NAN;
    }
    for (int i = 0; i < PCR_N && PCR_ANGLE_STEP > 0.0; i++) {
        measured->q[i] = PCR_ANGLE_STEP * rint(measured->q[i] / PCR_ANGLE_STEP);
    }
    for (int i = 0; i < PCR_N && PCR_WRAPPED; i++) {
        const double turn = 6.283185307179586477;
        measured->q[i] -= turn * ceil(measured->q[i] / turn - 0.5);
    }
}

/* Rates that reach the motors in this step, which come later than any controller was told; mean rates where they come
   within a step. */
static void later(pcr_real (*waiting)[PCR_N], const pcr_real *told, pcr_real *u)
{
    memcpy(waiting[PCR_WAITING], told, PCR_N * sizeof *told);
    for (int i = 0; i < PCR_N; i++) {
        u[i] = PCR_WITHIN > 0.0 ? PCR_WITHIN * waiting[0][i] + (1.0 - PCR_WITHIN) * waiting[PCR_WAITING > 0][i]
                                : waiting[0][i];
    }
    memmove(waiting[0], waiting[PCR_WAITING > 0], PCR_WAITING * sizeof *waiting);
}

/* One run of the scene, with the rates that C decides or, `recorded`, with those of Python; times of control steps and plant steps are added to those that are there. */
static int run(int recorded, took *control, took *steps, double *square, double *away, int *others, double *apart)
{
    pcr_real on_the_way[PCR_REAL_DELAY + 1][PCR_N] = {{0.0}}, waiting[PCR_WAITING + 1][PCR_N] = {{0.0}}, u[PCR_N];
    pcr_measurement measured;
    pcr_output output;
    if (pcr_controller_init(&controller, NULL) != PCR_OK || pcr_plant_init(&plant, NULL) != PCR_OK) {
        return 1;
    }
    *square = hypot(plant.x[0] - pcr_vector_wanted[0][0], plant.x[1] - pcr_vector_wanted[0][1]);
    *square *= *square;
    *away = 0.0;
    *others = 0;
    *apart = 0.0;
    look(0);
    for (int k = 0, step = 0; k < PCR_PERIODS; k++) {
        measure(k, &measured);
        took began = begin();
        const pcr_result result = pcr_controller_step(&controller, &measured, &output);
        control[k] = end(began);
        if (result != PCR_OK) {
            printf("control step %d: result %d\n", k, (int)result);
            return 1;
        }
        for (int i = 0; i < PCR_N; i++) {
            *away = fmax(*away, fabs(output.u[i] - pcr_vector_u[k][i]));
        }
        *others += (int)output.rung != pcr_vector_rung[k] || output.iterations != pcr_vector_iterations[k];
        memcpy(on_the_way[PCR_REAL_DELAY], recorded ? pcr_vector_u[k] : output.u, sizeof output.u);
        for (int j = 0; j < PCR_STEPS_A_PERIOD; j++, step++) {
            if (pcr_vector_payload[step] != plant.payload && pcr_plant_carry(&plant, pcr_vector_payload[step])) {
                return 1;
            }
            later(waiting, on_the_way[0], u);
            began = begin();
            const pcr_result moved = pcr_plant_step(&plant, u, pcr_vector_force);
            steps[step] = end(began);
            if (moved != PCR_OK) {
                printf("plant step %d: result %d\n", step, (int)moved);
                return 1;
            }
            look(step + 1);
            const double ex = plant.x[0] - pcr_vector_wanted[step + 1][0];
            const double ey = plant.x[1] - pcr_vector_wanted[step + 1][1];
            *square += ex * ex + ey * ey;
        }
        for (int i = 0; i < PCR_STATES; i++) {
            *apart = fmax(*apart, fabs(plant.x[i] - pcr_vector_x[k][i]));
        }
        memmove(on_the_way[0], on_the_way[1 - (PCR_REAL_DELAY == 0)], PCR_REAL_DELAY * sizeof output.u);
    }
    return 0;
}

/* The recorded measurements once more, whatever the plant: inputs, rungs and iterations of each period. */
static int replay(double *away, int *others)
{
    pcr_measurement measured;
    pcr_output output;
    memset(&measured, 0, sizeof measured);
    *away = 0.0;
    *others = 0;
    if (pcr_controller_init(&controller, NULL) != PCR_OK) {
        return 1;
    }
    for (int k = 0; k < PCR_PERIODS; k++) {
        memcpy(measured.p, pcr_vector_measured[k], sizeof measured.p);
        memcpy(measured.v, pcr_vector_measured[k] + 2, sizeof measured.v);
        memcpy(measured.q, pcr_vector_measured[k] + 4, sizeof measured.q);
        if (pcr_controller_step(&controller, &measured, &output) != PCR_OK) {
            return 1;
        }
        for (int i = 0; i < PCR_N; i++) {
            *away = fmax(*away, fabs(output.u[i] - pcr_vector_u[k][i]));
        }
        *others += (int)output.rung != pcr_vector_rung[k] || output.iterations != pcr_vector_iterations[k];
    }
    return 0;
}

/* Of each period its shortest time in all runs, which do the same: what is left is the work, not the computer's others. */
static void least_of(const took *times, int runs, took *least)
{
    for (int k = 0; k < PCR_PERIODS; k++) {
        least[k] = times[k];
        for (int i = 1; i < runs; i++) {
            least[k].cpu = fmin(least[k].cpu, times[i * PCR_PERIODS + k].cpu);
        }
    }
}

/* For programs: all times in the order in which they were measured, [cpu, wall] of each control step, then of each plant
   step, as doubles. */
static int kept(const char *path, const took *control, size_t periods, const took *steps, size_t count)
{
    FILE *file = fopen(path, "wb");
    if (file == NULL) {
        return 0;
    }
    const int written = fwrite(control, sizeof *control, periods, file) == periods
                        && fwrite(steps, sizeof *steps, count, file) == count;
    return fclose(file) == 0 && written;
}

int main(int count, char **words)
{
    /* ./example 100000 FILE: so many control steps are timed, in as many runs as that takes, and their times written. */
    const int wanted = count > 1 ? atoi(words[1]) : PCR_PERIODS, runs = (wanted + PCR_PERIODS - 1) / PCR_PERIODS;
    const int periods = runs * PCR_PERIODS, per = PCR_STEPS_A_PERIOD;
    took *control = malloc(sizeof *control * (size_t)periods);
    took *steps = malloc(sizeof *steps * (size_t)(periods * per));
    double square = 0.0, away = 0.0, replayed = 0.0, apart = 0.0, ignored[2];
    int others = 0, other_rungs = 0, unused, failed = control == NULL || steps == NULL || runs < 1;
    failed = failed || run(1, control, steps, ignored, ignored + 1, &unused, &apart);
    for (int i = 0; i < runs && !failed; i++) {
        failed = run(0, control + i * PCR_PERIODS, steps + i * PCR_PERIODS * per, &square, &away, &others, ignored);
    }
    if (failed || replay(&replayed, &other_rungs)) {
        printf("failed\n");
        return 1;
    }
    const double rms = 1e3 * sqrt(square / (PCR_PERIODS * per + 1));
    printf("RMS error of the tip        %.12f mm\n", rms);
    printf("recorded by Python          %.12f mm, difference %.2g mm\n", pcr_vector_rms_mm, rms - pcr_vector_rms_mm);
    printf("rates, closed loop          differ by at most %.2g rad/s, rung or iterations in %d of %d periods\n", away,
           others, PCR_PERIODS);
    printf("rates, same measurements    differ by at most %.2g rad/s, rung or iterations in %d of %d periods\n",
           replayed, other_rungs, PCR_PERIODS);
    if (count > 2 && !kept(words[2], control, (size_t)periods, steps, (size_t)(periods * per))) {
        printf("cannot write %s\n", words[2]);
        return 1;
    }
    printf("plant, recorded rates       differs by at most %.2g m, m/s or rad\n", apart);
    static took least[PCR_PERIODS];
    least_of(control, runs, least);
    printf("\nCPU time [us]        p50       p95       p99     p99.9       max     steps\n");
    show("control step", control, periods);
    if (runs > 1) {
        show("least of runs", least, PCR_PERIODS);
    }
    show("plant step", steps, periods * per);
    printf("\ncontroller %lu bytes, plant %lu bytes\n", pcr_controller_size(), pcr_plant_size());
    free(control);
    free(steps);
    const int as_recorded = fabs(rms - pcr_vector_rms_mm) <= PCR_RMS_LOSS && replayed <= PCR_RATES_LOSS;
    return as_recorded && other_rungs <= PCR_OTHER_PERIODS && apart <= PCR_APART ? 0 : 2;
}
