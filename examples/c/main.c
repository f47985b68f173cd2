/* A small CANopen node in C under coboot: an object dictionary, NMT and a heartbeat. The code for
 * its bootloader is in coboot/; another program needs that folder and the lines here that call it.
 *
 * It uses only registers. Its core runs from the crystal, and the FPU stays off.
 */
#include BOARD

#include "board.h"
#include "can.h"
#include "objects.h"
#include "sdo.h"

/* The version of the program, set by its author. */
#ifndef VERSION
#define VERSION 1
#endif

/* For a start without a bootloader, and for a bit rate that is to be detected: this program cannot
 * detect it.
 */
#define DEFAULT_NODE_ID 1
#define DEFAULT_BIT_RATE UINT32_C(125000)

/* NMT states in a heartbeat, and NMT commands (CiA 301). */
enum { BOOT_UP = 0, STOPPED = 4, OPERATIONAL = 5, PRE_OPERATIONAL = 127 };
enum { START = 1, STOP = 2, ENTER_PRE_OPERATIONAL = 128, RESET_NODE = 129, RESET_COMMUNICATION = 130 };

/* The target of this image: coflash and the bootloader refuse it for other devices. */
COBOOT_LABEL(VENDOR_ID, PRODUCT_CODE, VERSION);

struct coboot_program program;
static uint8_t nmt_state = PRE_OPERATIONAL;

/* ---- Object dictionary ---- */

static uint32_t device_type = 0; /* No profile; the bootloader's is another. */
static uint32_t error_register = 0;
static uint32_t identity[5] = { 4, VENDOR_ID, PRODUCT_CODE, REVISION, 0 };
static uint32_t heartbeat_ms = 1000;
static uint32_t heartbeat_at_ms;

static uint32_t set_heartbeat(uint8_t sub, uint32_t value)
{
    (void)sub;
    heartbeat_ms = value;
    heartbeat_at_ms = board_now_ms() + value;
    return COBOOT_ABORT_NONE;
}

const struct object objects[] = {
    { 0x1000, 0, 4, &device_type, NULL },
    { 0x1001, 0, 1, &error_register, NULL },
    { 0x1017, 0, 2, &heartbeat_ms, set_heartbeat },
    { 0x1018, 0, 1, &identity[0], NULL },
    { 0x1018, 1, 4, &identity[1], NULL },
    { 0x1018, 2, 4, &identity[2], NULL },
    { 0x1018, 3, 4, &identity[3], NULL },
    { 0x1018, 4, 4, &identity[4], NULL },
    { 0 },
};

/* ---- Program control ---- */

/* Whether the device may leave now, for its bootloader or for a reset. It is asked once, before a
 * command is answered: 1F51h = 80h, 0, 2 and 3. A machine that moves answers false, and the command
 * is refused. After true the reset follows within half a second: until then nothing may start to
 * move that stands (coboot_program_leaving).
 */
static bool may_leave(void)
{
    return true;
}

/* 1F51h = 80h: a master calls the bootloader in the place of the program `sub`.
 *
 * It only takes a note. coboot_program_proceed resets the chip when the answer is on the bus and some
 * 10 ms have passed, so nothing has to wait here, as the manual's TgtStartBootloader does. The first
 * 80h to a program that has just been downloaded and started confirms that program instead.
 */
static uint32_t start_bootloader(uint8_t sub)
{
    return coboot_program_write(&program, COBOOT_PROGRAM_CONTROL, sub, COBOOT_START_BOOTLOADER, board_now_ms());
}

/* The callback of a download to 1F51h, AppCbProgramCtrl of the SYS TEC manual (L-1112d_10, 4.5). It
 * runs before the SDO answer is sent: COBOOT_ABORT_NONE gives the positive answer, any other value is
 * the code of the abort.
 */
uint32_t app_cb_program_ctrl(uint8_t sub, uint32_t value)
{
    if (value == COBOOT_START_BOOTLOADER) {
        return start_bootloader(sub);
    }
    /* The other commands: stop, start, reset and clear a program. */
    return coboot_program_write(&program, COBOOT_PROGRAM_CONTROL, sub, value, board_now_ms());
}

/* ---- The node ---- */

static void send_state(uint8_t state)
{
    const struct can_frame frame = { (uint16_t)(0x700 + program.node_id), 1, { state } };
    can_send(CAN_HEARTBEAT, &frame);
}

static void nmt(const struct can_frame *frame)
{
    if (frame->len != 2 || (frame->data[1] != 0 && frame->data[1] != program.node_id)) {
        return;
    }
    switch (frame->data[0]) {
    case START:
        nmt_state = OPERATIONAL;
        break;
    case STOP:
        nmt_state = STOPPED;
        break;
    case ENTER_PRE_OPERATIONAL:
        nmt_state = PRE_OPERATIONAL;
        break;
    case RESET_NODE:
    case RESET_COMMUNICATION: /* There is little to reset: both go through a reset. */
        coboot_program_nmt_reset(&program, board_now_ms());
        break;
    default:
        break;
    }
}

static void handle(const struct can_frame *frame)
{
    struct can_frame answer = { (uint16_t)(program.sdo_response_base + program.node_id), 8, { 0 } };

    if (frame->id == 0) {
        nmt(frame);
    } else if (frame->len == 8 && nmt_state != STOPPED && sdo_answer(frame->data, answer.data)
               && !coboot_program_is_silent(&program)) {
        can_send(CAN_SDO, &answer);
    }
}

/* Takes the received frames. A request stays in the FIFO until there is room for its answer. */
static void receive(void)
{
    struct can_frame frame;

    while (!coboot_program_is_silent(&program) && can_is_free(CAN_SDO) && can_receive(&frame)) {
        handle(&frame);
    }
}

static void send_heartbeat(void)
{
    const bool due = heartbeat_ms != 0 && (int32_t)(board_now_ms() - heartbeat_at_ms) >= 0;

    if (due && !coboot_program_is_silent(&program) && can_is_free(CAN_HEARTBEAT)) {
        heartbeat_at_ms = board_now_ms() + heartbeat_ms;
        send_state(nmt_state);
    }
}

static void start_can(uint32_t clock)
{
    const uint16_t requests = (uint16_t)(program.sdo_request_base + program.node_id);

    if (!can_start(clock, program.bit_rate, 0, requests)) {
        /* The bootloader will start with another bit rate. */
        program.bootloader_answers = false;
        (void)can_start(clock, DEFAULT_BIT_RATE, 0, requests);
    }
}

int main(void)
{
    coboot_program_init(&program, DEFAULT_NODE_ID, DEFAULT_BIT_RATE);
    program.may_leave = may_leave;
    if (program.nameplate != NULL) {
        identity[1] = program.nameplate->vendor_id;
        identity[2] = program.nameplate->product_code;
        identity[3] = program.nameplate->revision;
    }
    identity[4] = program.serial_number;
    start_can(board_start());
    send_state(BOOT_UP);
    heartbeat_at_ms = board_now_ms() + heartbeat_ms;

    uint32_t blink_at_ms = board_now_ms();
    for (;;) {
        const uint32_t now_ms = board_now_ms();
        coboot_program_proceed(&program, can_is_free(CAN_SDO) && can_is_free(CAN_HEARTBEAT), now_ms);
        receive();
        send_heartbeat();
        if ((int32_t)(now_ms - blink_at_ms) >= 0) {
            blink_at_ms = now_ms + 500;
            board_toggle_led();
        }
        if (!coboot_program_is_silent(&program)) {
            board_wait();
        }
    }
}
