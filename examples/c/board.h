/* The board: core clock, pins, LED and a clock of milliseconds. The build selects the board's
 * header `BOARD` (boards/).
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Sets the board up. Returns the clock of core and buses, in Hz. */
uint32_t board_start(void);
/* Milliseconds since board_start; the count wraps. */
uint32_t board_now_ms(void);
void board_toggle_led(void);
/* Waits for the next interrupt, for a millisecond at most. */
void board_wait(void);

#ifdef __cplusplus
}
#endif
#endif
