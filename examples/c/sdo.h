/* An SDO server with expedited transfers, which are enough for numbers (CiA 301, 7.2.4.3). */
#ifndef SDO_H
#define SDO_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Answers a request of 8 bytes from the object dictionary. False if there is no answer. */
bool sdo_answer(const uint8_t request[8], uint8_t answer[8]);

#ifdef __cplusplus
}
#endif
#endif
