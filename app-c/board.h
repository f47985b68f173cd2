/* The board: core clock, pins, LED and a clock of milliseconds. Which board it is says the header `BOARD`, chosen by the
 * build (boards/).
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Sets them up. Gives the clock of core and buses, in Hz. */
uint32_t board_start(void);
/* Milliseconds since then; runs over. */
uint32_t board_now_ms(void);
void board_toggle_led(void);
/* Until the next interrupt, a millisecond at most. */
void board_wait(void);

#ifdef __cplusplus
}
#endif
#endif
