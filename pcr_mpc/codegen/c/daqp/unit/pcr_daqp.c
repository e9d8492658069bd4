/* DAQP's own files as one unit, in which what a controller has no use for falls away: nothing is allocated, and problems
   are neither reduced nor presolved. */
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "pcr_qp.h"
#include "presolve.h"
#include "utils.h"

#define malloc(size) NULL
#define calloc(count, size) NULL
#define free(memory) ((void)(memory))

int daqp_eq_wanted(const DAQPWorkspace *work, const DAQPProblem *qp, const int mask)
{
    (void)work, (void)qp, (void)mask;
    return 0;
}

int daqp_eq_update(DAQPWorkspace *work, DAQPProblem *qp, int mask, int (*update)(int, DAQPWorkspace *, DAQPProblem *))
{
    (void)work, (void)qp, (void)mask, (void)update;
    return DAQP_EQ_NOT_REDUCED;
}

void daqp_eq_deactivate(DAQPWorkspace *work)
{
    (void)work;
}

void daqp_eq_restore(DAQPWorkspace *work)
{
    (void)work;
}

DAQPProblem *daqp_presolve(DAQPWorkspace *work, DAQPProblem *qp)
{
    (void)work;
    return qp;
}

#include "../src/auxiliary.c"
#include "../src/factorization.c"
#include "../src/daqp.c"
#include "../src/utils.c"
