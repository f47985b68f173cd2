/* Object 2100h: the callgate by hand, so that a client can call each service with arguments of its own, bad ones too. A
 * product has no use for it.
 */
#ifndef PROBE_H
#define PROBE_H

#include <stdint.h>

/* Sub-indices of 2100h. */
enum probe_sub {
    PROBE_SELECTOR = 1,
    /* What is handed over: PROBE_ADDRESS is good, everything else is a lie. */
    PROBE_POINTER = 2,
    /* The words of the argument structure, up to PROBE_WORD + PROBE_WORDS - 1. */
    PROBE_WORD = 3,
    PROBE_WORDS = 5,
    /* Written: calls. Read: the status of the last call. */
    PROBE_CALL = 8,
    /* Bytes of stack that the last call wrote to. */
    PROBE_STACK = 9,
    /* Where the argument structure is. */
    PROBE_ADDRESS = 10,
    /* What all free RAM is filled with before a call: seed of a pattern. */
    PROBE_SEED = 11,
    /* 1: this program has the flash controller open, as somebody who is programming; 0: it is locked. */
    PROBE_FLASH_OPEN = 12,
    /* Where the stack pointer was at the last call. */
    PROBE_SP = 13,
    PROBE_LAST = PROBE_SP,
};

extern uint32_t probe_values[PROBE_LAST + 1];

void probe_init(void);
void probe_call(void);
void probe_open_flash(void);

#endif
