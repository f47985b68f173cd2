/* CAN1 at register level (RM0090 section 32), polled. */
#ifndef CAN_H
#define CAN_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

struct can_frame {
    uint16_t id;
    uint8_t len;
    uint8_t data[8];
};

/* Transmit mailboxes, one for each sender, so that no sender waits for another. */
enum can_mailbox { CAN_SDO, CAN_HEARTBEAT };

/* Joins the bus, and receives these two identifiers. False if `clock` (Hz) cannot make the bit
 * rate.
 */
bool can_start(uint32_t clock, uint32_t bit_rate, uint16_t hear_1, uint16_t hear_2);
/* Whether a mailbox is free: its last frame is on the bus and acknowledged. */
bool can_is_free(enum can_mailbox mailbox);
/* Sends a frame through a free mailbox. */
void can_send(enum can_mailbox mailbox, const struct can_frame *frame);
/* Takes the next frame. False if there is none. */
bool can_receive(struct can_frame *frame);

#ifdef __cplusplus
}
#endif
#endif
