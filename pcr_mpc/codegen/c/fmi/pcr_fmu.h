/* What both versions of FMI and both parts, plant and controller, share.

   A variable is known by its value reference: first the real numbers, inputs before fixed parameters before tunable ones
   before outputs, then the whole numbers, which are outputs, then the time. pcr_fmu_config.h says where each begins. */
#ifndef PCR_FMU_H
#define PCR_FMU_H

#include <stddef.h>

#include "pcr.h"
#include "pcr_fmu_config.h"

#if FMU_OF_PLANT
typedef pcr_plant fmu_part;
#else
typedef pcr_controller fmu_part;
#endif

#define FMU_NEAR 1e-3 /* of a step: times that differ by less are one, as importers add up steps */

/* As both versions of FMI count them. */
typedef enum { FMU_OK, FMU_WARNING, FMU_DISCARD, FMU_ERROR } fmu_status;
typedef enum { FMU_INSTANTIATED, FMU_INITIALISING, FMU_STEPPING, FMU_TERMINATED, FMU_FAILED } fmu_phase;

/* All that a run depends on; a copy of it is a state in the sense of FMI. */
typedef struct {
    char token[sizeof FMU_TOKEN];
    fmu_phase phase;
    int started;          /* the part is, from the values as they are */
    int changed;          /* tunable parameters have not taken effect yet */
    double start, time;   /* [s] */
    double periods;       /* that a controller has decided */
    double reals[FMU_REALS];
    int wholes[FMU_WHOLES];
    fmu_part part;
} fmu_state;

typedef struct fmu fmu;
typedef void fmu_logger(const fmu *instance, fmu_status status, const char *category, const char *text);

struct fmu {
    fmu_state state;
    fmu_logger *log;
    void *environment;
    void (*callback)(void); /* of the importer, whose type the version of FMI knows */
    char name[];
};

extern const double pcr_fmu_starts[FMU_TUNABLE_END]; /* of inputs and parameters */
extern const char *const pcr_fmu_inputs[FMU_INPUTS_END];
extern const char *const pcr_fmu_tunables[]; /* and those of parameters that may change */

/* NULL if the token is that of another model, or if there is no memory. */
fmu *fmu_new(const char *name, const char *token, fmu_logger *log, void *environment, void (*callback)(void));
void fmu_reset(fmu *instance);

/* Tell the importer; returns the status. */
fmu_status fmu_say(const fmu *instance, fmu_status status, const char *format, ...);

fmu_status fmu_set_start(fmu *instance, double start);
fmu_status fmu_enter(fmu *instance);
fmu_status fmu_exit(fmu *instance);
fmu_status fmu_terminate(fmu *instance);
fmu_status fmu_step(fmu *instance, double time, double step);

fmu_status fmu_get_reals(fmu *instance, const unsigned *at, size_t count, double *values);
fmu_status fmu_set_reals(fmu *instance, const unsigned *at, size_t count, const double *values);
fmu_status fmu_get_wholes(fmu *instance, const unsigned *at, size_t count, int *values);

/* There are no variables of another type; `count` of them are asked for. */
fmu_status fmu_none(const fmu *instance, size_t count, const char *type);

fmu_status fmu_get_state(const fmu *instance, void **state);
fmu_status fmu_set_state(fmu *instance, const void *state);
fmu_status fmu_read_state(const fmu *instance, const void *bytes, size_t size, void **state);

/* pcr_fmu_plant.c, pcr_fmu_controller.c: start from the values as they are; let tunable parameters take effect; take a
   step, which leaves `time` where it has come to; be a copy of another. */
fmu_status fmu_part_start(fmu *instance);
fmu_status fmu_part_tune(fmu *instance);
fmu_status fmu_part_step(fmu *instance, double step);
void fmu_part_restore(fmu_part *part, const fmu_part *saved);

#endif
