#include "can.h"

#include "registers.h"

/* How often the controller is asked whether it has entered initialisation. It does so within a frame; the
 * clock of the controller may be off or wrong.
 */
#define CAN_PATIENCE 1000000U

static uint32_t distance(uint32_t a, uint32_t b)
{
    return a > b ? a - b : b - a;
}

/* The register value of the bit timing with the sample point nearest to 87.5 % (CiA 301), and of those the
 * one with the most quanta (section 32.7.7), or 0. An edge may move the sample point by as many quanta as
 * segment 2 has, four at most.
 */
static uint32_t bit_timing(uint32_t clock, uint32_t bit_rate)
{
    if (bit_rate == 0 || clock % bit_rate != 0) {
        return 0;
    }
    const uint32_t cycles = clock / bit_rate;
    uint32_t best = 0;
    uint32_t best_quanta = 1;
    uint32_t best_distance = 1;
    for (uint32_t quanta = 25; quanta >= 8; quanta--) {
        const uint32_t segment_2 = (quanta + 4) / 8;
        const uint32_t segment_1 = quanta - 1 - segment_2;
        const uint32_t from_87_5 = distance(8 * segment_2, quanta);
        if (cycles % quanta == 0 && cycles / quanta <= 1024 && segment_1 <= 16
            && from_87_5 * best_quanta < best_distance * quanta) {
            best_quanta = quanta;
            best_distance = from_87_5;
            best = (cycles / quanta - 1) | (segment_1 - 1) << 16 | (segment_2 - 1) << 20
                   | (segment_2 - 1) << 24;
        }
    }
    return best;
}

/* An identifier in a filter bank with 16-bit lists: data frames with 11 bits. */
static uint32_t listed(uint16_t id)
{
    return (uint32_t)id << 5;
}

bool can_start(uint32_t clock, uint32_t bit_rate, uint16_t hear_1, uint16_t hear_2)
{
    const uint32_t timing = bit_timing(clock, bit_rate);
    if (timing == 0) {
        return false;
    }
    RCC_APB1ENR |= RCC_APB1ENR_CAN1EN;
    (void)RCC_APB1ENR;
    /* Leaves sleep mode and enters initialisation. */
    CAN_MCR = CAN_MCR_INRQ | CAN_MCR_ABOM;
    for (uint32_t patience = CAN_PATIENCE; (CAN_MSR & CAN_MSR_INAK) == 0; patience--) {
        if (patience == 0) {
            return false;
        }
    }
    CAN_BTR = timing;
    CAN_FMR |= CAN_FMR_FINIT;
    CAN_FA1R = 0;
    CAN_FM1R = 1;
    CAN_F0R1 = listed(hear_1) | listed(hear_2) << 16;
    CAN_F0R2 = CAN_F0R1;
    CAN_FA1R = 1;
    CAN_FMR &= ~CAN_FMR_FINIT;
    /* The controller itself waits for 11 recessive bits. */
    CAN_MCR = CAN_MCR_ABOM;
    return true;
}

bool can_is_free(enum can_mailbox mailbox)
{
    return (CAN_TSR & CAN_TSR_TME(mailbox)) != 0;
}

static uint32_t word_of(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

void can_send(enum can_mailbox mailbox, const struct can_frame *frame)
{
    CAN_TDTR(mailbox) = frame->len;
    CAN_TDLR(mailbox) = word_of(&frame->data[0]);
    CAN_TDHR(mailbox) = word_of(&frame->data[4]);
    CAN_TIR(mailbox) = (uint32_t)frame->id << 21 | CAN_TIR_TXRQ;
}

bool can_receive(struct can_frame *frame)
{
    if ((CAN_RF0R & CAN_RF0R_FMP0) == 0) {
        return false;
    }
    const uint32_t words[2] = { CAN_RDL0R, CAN_RDH0R };
    frame->id = (uint16_t)(CAN_RI0R >> 21);
    const uint32_t len = CAN_RDT0R & 0xF;
    frame->len = len < 8 ? (uint8_t)len : 8;
    for (unsigned i = 0; i < 8; i++) {
        frame->data[i] = (uint8_t)(words[i / 4] >> 8 * (i % 4));
    }
    CAN_RF0R = CAN_RF0R_RFOM0;
    /* The controller clears the bit (section 32.9.2). If it never does, the frame is taken again. */
    for (uint32_t patience = CAN_PATIENCE; (CAN_RF0R & CAN_RF0R_RFOM0) != 0 && patience > 0; patience--) {
    }
    return true;
}
