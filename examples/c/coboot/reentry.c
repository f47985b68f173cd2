#include "reentry.h"

#include "coboot.h"

/* The time between an answer on the bus and the reset: at least 10 ms (SYS TEC manual L-1112d_10,
 * 4.5), and one more because the current millisecond may be almost over.
 */
#define ANSWER_TO_RESET_MS 11
/* The longest time after the first answer: neither a bus without acknowledgement nor a client with
 * endless requests delays the reset longer.
 */
#define ANSWERED_MOST_MS 500
/* The longest time that a command with an owed answer waits for a frame that is being sent. The
 * client has its answer within 25 ms.
 */
#define OWED_MOST_MS 15

static bool has_passed(uint32_t time_ms, uint32_t now_ms)
{
    return (int32_t)(now_ms - time_ms) >= 0;
}

/* Whether a master relies on the request: the bootloader must come up, or a value must be stored.
 */
static bool is_promise(uint32_t request)
{
    return request != COBOOT_REQUEST_START && request != COBOOT_REQUEST_POWER_ON && request != COBOOT_REQUEST_RESCUE;
}

/* Whether the bootloader is to store a value. */
static bool stores(uint32_t request)
{
    return request == COBOOT_REQUEST_CONFIRM || request == COBOOT_REQUEST_STORE_NODE;
}

bool coboot_reentry_begin(struct coboot_reentry *reentry, uint32_t request, uint32_t argument, uint32_t now_ms)
{
    const bool first = reentry->phase == COBOOT_STAYS;
    /* A value to store and another promise exclude each other: each is all that the bootloader gets. */
    const bool differs = !first && is_promise(reentry->request) && request != reentry->request;

    if (reentry->silent || (differs && (stores(reentry->request) || stores(request)))) {
        return false;
    }
    /* An answered STOP leads into the bootloader, too, which has to count it. */
    const bool is_in_it = reentry->request == COBOOT_REQUEST_OWED && request == COBOOT_REQUEST_STAY;
    if (first || (is_promise(request) && !is_in_it) || !is_promise(reentry->request)) {
        reentry->request = request;
        reentry->argument = argument;
    }
    if (request == COBOOT_REQUEST_OWED && coboot_owed_node(argument) != 0) {
        reentry->silent = true;
        reentry->latest_ms = now_ms + OWED_MOST_MS;
        if (first) {
            /* Nothing was answered before, so there is no pause. */
            reentry->phase = COBOOT_PAUSES;
            reentry->pause_ends_ms = now_ms;
        }
        return true;
    }
    if (first) {
        reentry->latest_ms = now_ms + ANSWERED_MOST_MS;
    }
    /* A pause follows each answer. */
    reentry->phase = COBOOT_ANSWERS;
    return true;
}

enum coboot_next coboot_reentry_proceed(struct coboot_reentry *reentry, bool quiet, uint32_t now_ms)
{
    if (reentry->phase == COBOOT_STAYS) {
        return COBOOT_SERVE;
    }
    if (reentry->phase == COBOOT_ANSWERS && quiet) {
        reentry->phase = COBOOT_PAUSES;
        reentry->pause_ends_ms = now_ms + ANSWER_TO_RESET_MS;
    }
    const bool over = reentry->phase == COBOOT_PAUSES && has_passed(reentry->pause_ends_ms, now_ms);
    if ((quiet && over) || has_passed(reentry->latest_ms, now_ms)) {
        return COBOOT_LEAVE;
    }
    return reentry->silent ? COBOOT_WAIT : COBOOT_SERVE;
}
