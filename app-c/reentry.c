#include "reentry.h"

#include "can.h"
#include "coboot.h"

/* How long the device stays after the answer to 80h is on the bus: at least 10 ms (SYS TEC manual L-1112d_10, 4.5), and one
 * that may be almost over.
 */
#define ANSWER_TO_RESET_MS 11
/* The longest that it stays: a bus on which nobody acknowledges the answer keeps it no longer, and neither does a client
 * that asks without end.
 */
#define ANSWERED_MOST_MS 500
/* The longest that a command waits whose answer is owed, for a frame that is on its way. The client has its answer within
 * 25 ms.
 */
#define OWED_MOST_MS 15

/* 80h, 2 and NMT resets: the answer; at least 10 ms more, in which requests are served; the reset. 0 and 3, whose answer is
 * owed: silence and the reset, at once.
 */
static struct {
    bool pending, silent;
    uint32_t request, argument;
    /* How long it stays behind the last answer, and until when; `counting` from when that is on the bus. */
    uint32_t pause_ms, at_ms;
    bool counting;
    uint32_t latest_ms;
} reentry;

bool reentry_begin(uint32_t request, uint32_t argument, uint32_t now_ms)
{
    const bool owed = request == COBOOT_REQUEST_OWED;

    if (reentry.pending && reentry.request == COBOOT_REQUEST_CONFIRM && request != COBOOT_REQUEST_CONFIRM) {
        return false;
    }
    if (!reentry.pending) {
        reentry.pause_ms = owed ? 0 : ANSWER_TO_RESET_MS;
        reentry.latest_ms = now_ms + (owed ? OWED_MOST_MS : ANSWERED_MOST_MS);
    }
    if (!reentry.pending || owed || reentry.request != COBOOT_REQUEST_STAY) {
        reentry.request = request;
        reentry.argument = argument;
    }
    reentry.pending = true;
    if (owed) {
        reentry.silent = true;
    } else {
        reentry.counting = false;
    }
    return true;
}

bool reentry_proceed(uint32_t now_ms)
{
    const bool quiet = can_is_free(CAN_SDO) && can_is_free(CAN_HEARTBEAT);

    if (!reentry.pending) {
        return false;
    }
    if (quiet && !reentry.counting) {
        reentry.counting = true;
        reentry.at_ms = now_ms + reentry.pause_ms;
    }
    const bool over = reentry.counting && (int32_t)(now_ms - reentry.at_ms) >= 0;
    if ((quiet && over) || (int32_t)(now_ms - reentry.latest_ms) >= 0) {
        coboot_reset(reentry.request, reentry.argument);
    }
    return reentry.silent;
}

bool reentry_is_silent(void)
{
    return reentry.silent;
}
