/* When a program leaves for the bootloader: rules over time, without the chip and without CAN. */
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
    COBOOT_PAUSES,  /* everything is answered, and the pause behind it runs */
};

/* The way out. Begins as zeros. */
struct coboot_reentry {
    enum coboot_phase phase;
    /* Nothing is said or served any more: the bootloader answers in this program's place. */
    bool silent;
    /* A COBOOT_REQUEST_… and its argument. */
    uint32_t request, argument;
    /* When the pause is over (COBOOT_PAUSES), and when the device leaves whatever waits to be sent. */
    uint32_t pause_ends_ms, latest_ms;
};

/* A command was taken for which the device leaves. All requests but COBOOT_REQUEST_OWED are answered first: this program
 * serves for 10 ms behind that answer. With COBOOT_REQUEST_OWED it says nothing any more.
 *
 * What a master was promised before holds: a device that it has called back comes up in the bootloader, although another
 * master restarts it meanwhile, and what is to be stored is stored. False where that forbids this request.
 */
bool coboot_reentry_begin(struct coboot_reentry *reentry, uint32_t request, uint32_t argument, uint32_t now_ms);

/* Call it as often as the CAN mailboxes change, once per millisecond at least. `quiet`: no answer waits to be sent, and all
 * mailboxes are empty. `now_ms` may run over.
 */
enum coboot_next coboot_reentry_proceed(struct coboot_reentry *reentry, bool quiet, uint32_t now_ms);

#ifdef __cplusplus
}
#endif
#endif
