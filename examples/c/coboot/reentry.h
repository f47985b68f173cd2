/* When a program leaves for the bootloader: rules over time, without access to the chip or CAN. */
#ifndef COBOOT_REENTRY_H
#define COBOOT_REENTRY_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What the program does next. */
enum coboot_next {
    COBOOT_SERVE, /* serve as always */
    COBOOT_WAIT,  /* take no request and send nothing; the frames in the mailboxes go out */
    COBOOT_LEAVE, /* reset with `request` and `argument` (coboot_reset) */
};

enum coboot_phase {
    COBOOT_STAYS,   /* nobody asked it to leave: as it begins */
    COBOOT_ANSWERS, /* the answer to a command is not on the bus yet */
    COBOOT_PAUSES,  /* everything is answered, and the pause after it runs */
};

/* The state of the return to the bootloader. All zeros at the start. */
struct coboot_reentry {
    enum coboot_phase phase;
    /* Nothing is sent or served any more: the bootloader answers for this program. */
    bool silent;
    /* A COBOOT_REQUEST_… and its argument. */
    uint32_t request, argument;
    /* The end of the pause (COBOOT_PAUSES), and the latest time of the reset, even if frames wait
     * to be sent.
     */
    uint32_t pause_ends_ms, latest_ms;
};

/* Takes a command that makes the device leave. All requests but COBOOT_REQUEST_OWED with a node-ID
 * are answered first: this program serves for 10 ms after that answer. With an answer that the
 * bootloader owes it sends nothing any more.
 *
 * An earlier promise to a master holds: a device that one master has called back comes up in the
 * bootloader, even if another master restarts it meanwhile, and a value to be stored is stored.
 * False if that forbids this request.
 */
bool coboot_reentry_begin(struct coboot_reentry *reentry, uint32_t request, uint32_t argument, uint32_t now_ms);

/* Call it after each change of the CAN mailboxes, at least once per millisecond. `quiet`: no answer
 * waits to be sent, and all mailboxes are empty. `now_ms` may wrap.
 */
enum coboot_next coboot_reentry_proceed(struct coboot_reentry *reentry, bool quiet, uint32_t now_ms);

#ifdef __cplusplus
}
#endif
#endif
