/* How OSQP is built: matrices may change, and nothing is allocated or printed. */
#ifndef OSQP_CONFIGURE_H
#define OSQP_CONFIGURE_H

#include "pcr_config.h"

#define OSQP_ALGEBRA_BUILTIN
#define OSQP_EMBEDDED_MODE 2
#if PCR_SINGLE
#define OSQP_USE_FLOAT
#endif

#endif
