/* The way back into the bootloader. */
#ifndef REENTRY_H
#define REENTRY_H

#include <stdbool.h>
#include <stdint.h>

/* Begins with the departure. What a master was promised before holds: a device that it has called back comes up in the
 * bootloader, although another one resets it meanwhile, and what is to be stored is stored. False where that forbids the
 * request.
 */
bool reentry_begin(uint32_t request, uint32_t argument, uint32_t now_ms);
/* Goes on with it; does not return when it is time. Whether the device is silent from now on. */
bool reentry_proceed(uint32_t now_ms);
/* Whether the device says and serves nothing any more: the bootloader owes what is to be answered. */
bool reentry_is_silent(void);

#endif
