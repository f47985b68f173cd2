/* A small CANopen node in C under coboot: how it comes up, what it may call, and the way back.
 *
 * It uses registers and nothing else; what it takes from coboot is in coboot.h. Its core runs from the crystal, and the FPU
 * stays off.
 */
/* Of the board, chosen by the build. */
#include BOARD

#include "can.h"
#include "coboot.h"
#include "registers.h"
#include "probe.h"

/* How long the device stays after the answer to 80h is on the bus: at least 10 ms (SYS TEC manual L-1112d_10, 4.5), and one
 * that may be almost over.
 */
#define ANSWER_TO_RESET_MS 11

/* Without a bootloader, or where it leaves the bit rate to be found out, which this program cannot do. */
#define DEFAULT_NODE_ID 1
#define DEFAULT_BIT_RATE UINT32_C(125000)

#define HSI_HZ UINT32_C(16000000)
/* How often it is asked whether the crystal runs: some 100 ms. */
#define PATIENCE 200000

/* Abort codes (CiA 301 table 22). */
enum abort_code {
    GOOD = 0,
    ABORT_COMMAND = 0x05040001,
    ABORT_READ_ONLY = 0x06010002,
    ABORT_NO_OBJECT = 0x06020000,
    ABORT_LENGTH = 0x06070010,
    ABORT_NO_SUB_INDEX = 0x06090011,
    ABORT_VALUE = 0x06090030,
    ABORT_DEVICE_STATE = 0x08000022,
};

/* NMT states as a heartbeat tells them, and commands (CiA 301). */
enum { BOOT_UP = 0, STOPPED = 4, OPERATIONAL = 5, PRE_OPERATIONAL = 127 };
enum { NMT_START = 1, NMT_STOP = 2, NMT_ENTER_PRE_OPERATIONAL = 128, NMT_RESET_NODE = 129, NMT_RESET_COMMUNICATION = 130 };

/* Values of 1F51h (CiA 302-3 and the SYS TEC manual, 3.4.4). */
enum { PROGRAM_STOP = 0, PROGRAM_START = 1, PROGRAM_RESET_STAT = 2, PROGRAM_CLEAR = 3 };
enum { PROGRAM_START_BOOTLOADER = 0x80, PROGRAM_SET_SIGNATURE = 0x83, PROGRAM_CLR_SIGNATURE = 0x84 };

static volatile uint32_t now_ms;

static uint8_t node_id = DEFAULT_NODE_ID;
static uint8_t program_number = 1;
static uint8_t nmt_state = PRE_OPERATIONAL;

/* The way out: first the answer, then a while in which nothing is said any more, then the reset. */
static enum { REENTRY_IDLE, ANSWER_PENDING, RESET_PENDING } reentry;
static uint32_t reentry_request, reentry_argument;
static uint32_t reset_at_ms;

/* Values of the object dictionary. */
static uint32_t device_type = 0; /* No profile; the bootloader's is another. */
static uint32_t error_register = 0;
static uint32_t heartbeat_ms = 1000;
static uint32_t heartbeat_at_ms;
static uint32_t identity[5] = { 4, VENDOR_ID, PRODUCT_CODE, REVISION, 0 };
static uint32_t one = 1;
static uint32_t program_crc;
static uint32_t flash_status = 0;

enum access { RO, RW };

struct object {
    uint16_t index;
    uint8_t sub;
    /* In bytes. */
    uint8_t size;
    enum access access;
    uint32_t *value;
};

static const struct object objects[] = {
    { 0x1000, 0, 4, RO, &device_type },
    { 0x1001, 0, 1, RO, &error_register },
    { 0x1017, 0, 2, RW, &heartbeat_ms },
    { 0x1018, 0, 1, RO, &identity[0] },
    { 0x1018, 1, 4, RO, &identity[1] },
    { 0x1018, 2, 4, RO, &identity[2] },
    { 0x1018, 3, 4, RO, &identity[3] },
    { 0x1018, 4, 4, RO, &identity[4] },
    { 0x1F51, 0, 1, RO, &one },
    /* 1: it runs. */
    { 0x1F51, 1, 1, RW, &one },
    { 0x1F56, 0, 1, RO, &one },
    { 0x1F56, 1, 4, RO, &program_crc },
    { 0x1F57, 0, 1, RO, &one },
    { 0x1F57, 1, 4, RO, &flash_status },
    { 0x2100, 0, 1, RO, &probe_values[0] },
    { 0x2100, PROBE_SELECTOR, 4, RW, &probe_values[PROBE_SELECTOR] },
    { 0x2100, PROBE_POINTER, 4, RW, &probe_values[PROBE_POINTER] },
    { 0x2100, PROBE_WORD + 0, 4, RW, &probe_values[PROBE_WORD + 0] },
    { 0x2100, PROBE_WORD + 1, 4, RW, &probe_values[PROBE_WORD + 1] },
    { 0x2100, PROBE_WORD + 2, 4, RW, &probe_values[PROBE_WORD + 2] },
    { 0x2100, PROBE_WORD + 3, 4, RW, &probe_values[PROBE_WORD + 3] },
    { 0x2100, PROBE_WORD + 4, 4, RW, &probe_values[PROBE_WORD + 4] },
    { 0x2100, PROBE_CALL, 4, RW, &probe_values[PROBE_CALL] },
    { 0x2100, PROBE_STACK, 4, RO, &probe_values[PROBE_STACK] },
    { 0x2100, PROBE_ADDRESS, 4, RO, &probe_values[PROBE_ADDRESS] },
    { 0x2100, PROBE_SEED, 4, RW, &probe_values[PROBE_SEED] },
    { 0x2100, PROBE_FLASH_OPEN, 4, RW, &probe_values[PROBE_FLASH_OPEN] },
    { 0x2100, PROBE_SP, 4, RO, &probe_values[PROBE_SP] },
};

void tick(void);

void tick(void)
{
    now_ms++;
}

/* ---- Object dictionary ---- */

static enum abort_code find(uint16_t index, uint8_t sub, const struct object **found)
{
    enum abort_code why = ABORT_NO_OBJECT;
    for (unsigned i = 0; i < sizeof objects / sizeof *objects; i++) {
        if (objects[i].index == index) {
            why = ABORT_NO_SUB_INDEX;
            if (objects[i].sub == sub) {
                *found = &objects[i];
                return GOOD;
            }
        }
    }
    return why;
}

/* The 1F51h callback. It runs before the answer is sent, so it only notes what is to be done. */
static enum abort_code depart_with(uint32_t request, uint32_t argument)
{
    reentry = ANSWER_PENDING;
    reentry_request = request;
    reentry_argument = argument;
    return GOOD;
}

static enum abort_code program_control(uint32_t command)
{
    switch (command) {
    case PROGRAM_START_BOOTLOADER:
    case PROGRAM_STOP: /* The bootloader runs instead. */
        return depart_with(COBOOT_REQUEST_STAY, 0);
    case PROGRAM_START: /* It runs already. */
        return GOOD;
    case PROGRAM_RESET_STAT: /* CiA 302-3: reset program, which starts it anew. */
        return depart_with(COBOOT_REQUEST_START, program_number);
    case PROGRAM_CLEAR: /* The bootloader carries it out. */
        return depart_with(COBOOT_REQUEST_CLEAR, program_number);
    case PROGRAM_SET_SIGNATURE:
    case PROGRAM_CLR_SIGNATURE: /* The bootloader's to do. */
        return ABORT_DEVICE_STATE;
    default:
        return ABORT_VALUE;
    }
}

static enum abort_code write(const struct object *object, uint32_t value)
{
    if (object->access == RO) {
        return ABORT_READ_ONLY;
    }
    if (object->index == 0x1F51) {
        return program_control(value);
    }
    if (object->index == 0x2100 && object->sub == PROBE_CALL) {
        probe_call();
        return GOOD;
    }
    *object->value = value;
    if (object->value == &heartbeat_ms) {
        heartbeat_at_ms = now_ms + heartbeat_ms;
    } else if (object->value == &probe_values[PROBE_FLASH_OPEN]) {
        probe_open_flash();
    }
    return GOOD;
}

/* ---- SDO server: expedited transfers, which is enough for numbers (CiA 301, 7.2.4.3) ---- */

static uint32_t word_at(const uint8_t *bytes)
{
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static void put_word(uint8_t *bytes, uint32_t word)
{
    for (unsigned i = 0; i < 4; i++) {
        bytes[i] = (uint8_t)(word >> 8 * i);
    }
}

enum { CCS_DOWNLOAD = 1, CCS_UPLOAD = 2, CS_ABORT = 4 };

static enum abort_code download(const struct object *object, const uint8_t *request)
{
    const uint8_t expedited = request[0] >> 1 & 1, size_indicated = request[0] & 1, unused = request[0] >> 2 & 3;
    if (!expedited || (size_indicated && object->size != 4 - unused)) {
        return object->access == RO ? ABORT_READ_ONLY : ABORT_LENGTH;
    }
    const uint32_t mask = object->size == 4 ? UINT32_MAX : (UINT32_C(1) << 8 * object->size) - 1;
    return write(object, word_at(&request[4]) & mask);
}

/* Answers a request of 8 bytes. False where there is nothing to say. */
static bool sdo(const uint8_t *request, uint8_t *answer)
{
    const unsigned specifier = request[0] >> 5;
    const uint16_t index = (uint16_t)(request[1] | request[2] << 8);
    const struct object *object = NULL;
    enum abort_code abort = ABORT_COMMAND;

    if (specifier == CS_ABORT) {
        return false;
    }
    for (unsigned i = 0; i < 8; i++) {
        answer[i] = i >= 1 && i <= 3 ? request[i] : 0;
    }
    if (specifier == CCS_DOWNLOAD || specifier == CCS_UPLOAD) {
        abort = find(index, request[3], &object);
    }
    if (abort == GOOD && specifier == CCS_DOWNLOAD) {
        abort = download(object, request);
        answer[0] = 0x60;
    } else if (abort == GOOD) {
        answer[0] = (uint8_t)(0x43 | (4 - object->size) << 2);
        put_word(&answer[4], *object->value);
    }
    if (abort != GOOD) {
        answer[0] = 0x80;
        put_word(&answer[4], abort);
    }
    return true;
}

/* ---- The node ---- */

static void send_state(uint8_t state)
{
    const struct can_frame frame = { (uint16_t)(0x700 + node_id), 1, { state } };
    can_send(CAN_HEARTBEAT, &frame);
}

static void nmt(const struct can_frame *frame)
{
    if (frame->len != 2 || (frame->data[1] != 0 && frame->data[1] != node_id)) {
        return;
    }
    switch (frame->data[0]) {
    case NMT_START:
        nmt_state = OPERATIONAL;
        break;
    case NMT_STOP:
        nmt_state = STOPPED;
        break;
    case NMT_ENTER_PRE_OPERATIONAL:
        nmt_state = PRE_OPERATIONAL;
        break;
    case NMT_RESET_NODE:
    case NMT_RESET_COMMUNICATION:
        /* There is little to reset: both go through a reset that nobody takes for a crash. */
        (void)depart_with(COBOOT_REQUEST_POWER_ON, 0);
        break;
    default:
        break;
    }
}

static void handle(const struct can_frame *frame)
{
    if (frame->id == 0) {
        nmt(frame);
    } else if (frame->len == 8 && nmt_state != STOPPED) {
        struct can_frame answer = { (uint16_t)(0x580 + node_id), 8, { 0 } };
        if (sdo(frame->data, answer.data)) {
            can_send(CAN_SDO, &answer);
        }
    }
}

/* Goes on with the departure. Whether the device is silent from now on. */
static bool start_reentry(void)
{
    if (reentry == ANSWER_PENDING && can_is_free(CAN_SDO) && can_is_free(CAN_HEARTBEAT)) {
        reentry = RESET_PENDING;
        reset_at_ms = now_ms + ANSWER_TO_RESET_MS;
    }
    if (reentry == RESET_PENDING && (int32_t)(now_ms - reset_at_ms) >= 0) {
        coboot_reset(reentry_request, reentry_argument);
    }
    return reentry != REENTRY_IDLE;
}

/* ---- The chip ---- */

/* Runs the core from the crystal, or from HSI where that does not come. Gives the clock of core and buses, in Hz. */
static uint32_t start_clock(void)
{
    RCC_CR |= HSE_BYPASS ? RCC_CR_HSEBYP : 0;
    RCC_CR |= RCC_CR_HSEON;
    for (uint32_t i = 0; i < PATIENCE; i++) {
        if ((RCC_CR & RCC_CR_HSERDY) != 0) {
            RCC_CFGR = RCC_CFGR_SW_HSE;
            while ((RCC_CFGR & RCC_CFGR_SWS) != RCC_CFGR_SWS_HSE) {
            }
            return HSE_HZ;
        }
    }
    return HSI_HZ;
}

static void set_up_pin(char port, unsigned pin, uint32_t mode, uint32_t alternate)
{
    RCC_AHB1ENR |= UINT32_C(1) << (port - 'A');
    (void)RCC_AHB1ENR;
    const unsigned place = 4 * (pin % 8);
    GPIO_AFR(port, pin) = (GPIO_AFR(port, pin) & ~(UINT32_C(0xF) << place)) | alternate << place;
    GPIO_MODER(port) = (GPIO_MODER(port) & ~(UINT32_C(3) << 2 * pin)) | mode << 2 * pin;
}

static void start_ticks(uint32_t clock)
{
    SYST_RVR = clock / 1000 - 1;
    SYST_CVR = 0;
    SYST_CSR = SYST_CSR_ENABLE_INTERRUPT_CORE;
}

void main(void);

void main(void)
{
    extern const uint8_t __vector_table, __image_end;
    struct coboot_handoff handoff;
    uint32_t bit_rate = DEFAULT_BIT_RATE;

    if (coboot_read_handoff(&handoff)) {
        node_id = handoff.node_id;
        program_number = (uint8_t)handoff.program;
        identity[4] = handoff.serial_number;
        if (handoff.bit_rate != 0) {
            bit_rate = handoff.bit_rate;
        }
    }
    const struct coboot_callgate *gate = coboot_callgate();
    /* What the bootloader has verified is larger than this image where more was downloaded with it. */
    const uint32_t start = (uint32_t)(uintptr_t)&__vector_table, end = (uint32_t)(uintptr_t)&__image_end;
    struct coboot_program_args program;
    if (gate != NULL && coboot_program_info(gate, program_number, &program) == COBOOT_STATUS_OK) {
        program_crc = program.crc;
    } else if (gate != NULL && coboot_crc32(gate, start, end - start, &program_crc) != COBOOT_STATUS_OK) {
        program_crc = 0;
    }
    probe_init();

    const uint32_t clock = start_clock();
    set_up_pin(CAN_PORT, CAN_RX_PIN, GPIO_MODE_ALTERNATE, GPIO_ALTERNATE_CAN1);
    set_up_pin(CAN_PORT, CAN_TX_PIN, GPIO_MODE_ALTERNATE, GPIO_ALTERNATE_CAN1);
    set_up_pin(LED_PORT, LED_PIN, GPIO_MODE_OUTPUT, 0);
    start_ticks(clock);
    const uint16_t requests = (uint16_t)(0x600 + node_id);
    if (!can_start(clock, bit_rate, 0, requests)) {
        (void)can_start(clock, DEFAULT_BIT_RATE, 0, requests);
    }

    send_state(BOOT_UP);
    heartbeat_at_ms = now_ms + heartbeat_ms;
    uint32_t blink_at_ms = now_ms;
    for (;;) {
        if (!start_reentry()) {
            struct can_frame frame;
            /* A request stays in the FIFO until its answer has room. */
            while (reentry == REENTRY_IDLE && can_is_free(CAN_SDO) && can_receive(&frame)) {
                handle(&frame);
            }
            if (heartbeat_ms != 0 && (int32_t)(now_ms - heartbeat_at_ms) >= 0 && can_is_free(CAN_HEARTBEAT)) {
                heartbeat_at_ms = now_ms + heartbeat_ms;
                send_state(nmt_state);
            }
        }
        if ((int32_t)(now_ms - blink_at_ms) >= 0) {
            blink_at_ms = now_ms + 500;
            GPIO_ODR(LED_PORT) ^= UINT32_C(1) << LED_PIN;
        }
        __asm volatile("wfi");
    }
}
