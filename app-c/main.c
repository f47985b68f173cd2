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
#include "reentry.h"

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
    ABORT_HARDWARE = 0x06060000,
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
/* What 1F51h reads of a program (CiA 302-3). */
enum { STATE_STOPPED = 0, STATE_RUNNING = 1, STATE_ABSENT = 3 };
/* Objects with an element for each program (SYS TEC manual, 3.4.1). */
enum { PROGRAM_CONTROL = 0x1F51, PROGRAM_ID = 0x1F56, FLASH_STATUS = 0x1F57 };

static volatile uint32_t now_ms;

static uint8_t node_id = DEFAULT_NODE_ID;
static uint8_t program_number = 1;
static uint8_t nmt_state = PRE_OPERATIONAL;

/* The callgate, if there is one. */
static const struct coboot_callgate *gate;
/* The next 80h to this program confirms it. */
static bool fresh;
/* The bootloader comes up with the same node-ID and bit rate, so that it can answer in this program's place. */
static bool bootloader_answers;

/* Values of the object dictionary. */
static uint32_t device_type = 0; /* No profile; the bootloader's is another. */
static uint32_t error_register = 0;
static uint32_t heartbeat_ms = 1000;
static uint32_t heartbeat_at_ms;
static uint32_t identity[5] = { 4, VENDOR_ID, PRODUCT_CODE, REVISION, 0 };
static uint32_t program_crc;

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

/* How many programs the device has. */
static uint32_t programs(void)
{
    extern const uint8_t __programs;
    return (uint32_t)(uintptr_t)&__programs;
}

/* An element of 1F51h, 1F56h or 1F57h, whichever program it is of. Element 0 is the number of programs. */
static enum abort_code find_element(uint16_t index, uint8_t sub, const struct object **found)
{
    static uint32_t value;
    static struct object element;
    struct coboot_program_args program;

    if (sub > programs()) {
        return ABORT_NO_SUB_INDEX;
    }
    const bool own = sub == program_number;
    const bool installed = gate != NULL && sub != 0 && !own
        && coboot_program_info(gate, sub, &program) == COBOOT_STATUS_OK
        && (program.flags & COBOOT_PROGRAM_INSTALLED) != 0;
    const uint8_t size = index == PROGRAM_CONTROL || sub == 0 ? 1 : 4;
    element = (struct object){ index, sub, size, index == PROGRAM_CONTROL && sub != 0 ? RW : RO, &value };
    if (sub == 0) {
        value = programs();
    } else if (index == PROGRAM_CONTROL) {
        value = own ? STATE_RUNNING : installed ? STATE_STOPPED : STATE_ABSENT;
    } else if (index == PROGRAM_ID) {
        value = own ? program_crc : installed ? program.crc : 0;
    } else {
        value = 0;
    }
    *found = &element;
    return GOOD;
}

static enum abort_code find(uint16_t index, uint8_t sub, const struct object **found)
{
    enum abort_code why = ABORT_NO_OBJECT;
    if (index == PROGRAM_CONTROL || index == PROGRAM_ID || index == FLASH_STATUS) {
        return find_element(index, sub, found);
    }
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

static enum abort_code depart(uint32_t request, uint32_t argument)
{
    return reentry_begin(request, argument, now_ms) ? GOOD : ABORT_DEVICE_STATE;
}

/* The 1F51h callback. It runs before the answer is sent, so it only notes what is to be done. */
static enum abort_code program_control(uint8_t program, uint32_t command)
{
    const bool own = program == program_number;

    switch (command) {
    case PROGRAM_START_BOOTLOADER:
        /* The first 80h right behind a download in one go means "confirm", to masters that do that. */
        if (own && fresh) {
            const int32_t status = gate != NULL ? coboot_confirm(gate, program) : COBOOT_STATUS_FAILED;
            if (status == COBOOT_STATUS_LOCKED) {
                /* The bootloader stores it. Until then an 80h that comes again means the same. */
                return depart(COBOOT_REQUEST_CONFIRM, program);
            }
            fresh = false;
            return status == COBOOT_STATUS_OK ? GOOD : ABORT_HARDWARE;
        }
        return depart(COBOOT_REQUEST_STAY, 0);
    case PROGRAM_STOP:  /* The bootloader runs instead. */
    case PROGRAM_CLEAR: /* The bootloader carries it out. */
        /* Masters send the next request as soon as they see the answer, so that is the bootloader's, too. */
        if (bootloader_answers) {
            return depart(COBOOT_REQUEST_OWED, coboot_owed(program, (uint8_t)command, node_id));
        }
        return command == PROGRAM_STOP ? depart(COBOOT_REQUEST_STAY, 0) : ABORT_DEVICE_STATE;
    case PROGRAM_START: /* It runs already; another one is the bootloader's to start. */
        return own ? GOOD : ABORT_DEVICE_STATE;
    case PROGRAM_RESET_STAT: /* CiA 302-3: reset program, which starts it anew. */
        return own ? depart(COBOOT_REQUEST_START, program) : ABORT_DEVICE_STATE;
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
    if (object->index == PROGRAM_CONTROL) {
        return program_control(object->sub, value);
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
    /* Who has fallen silent owes the answer. */
    return !reentry_is_silent();
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
        reentry_begin(COBOOT_REQUEST_POWER_ON, 0, now_ms);
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
        fresh = coboot_is_fresh(&handoff);
        if (handoff.bit_rate != 0) {
            bit_rate = handoff.bit_rate;
            bootloader_answers = true;
        }
    }
    gate = coboot_callgate();
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
        if (!reentry_proceed(now_ms)) {
            struct can_frame frame;
            /* A request stays in the FIFO until its answer has room. */
            while (!reentry_is_silent() && can_is_free(CAN_SDO) && can_receive(&frame)) {
                handle(&frame);
            }
            if (!reentry_is_silent() && heartbeat_ms != 0 && (int32_t)(now_ms - heartbeat_at_ms) >= 0 && can_is_free(CAN_HEARTBEAT)) {
                heartbeat_at_ms = now_ms + heartbeat_ms;
                send_state(nmt_state);
            }
        }
        if ((int32_t)(now_ms - blink_at_ms) >= 0) {
            blink_at_ms = now_ms + 500;
            GPIO_ODR(LED_PORT) ^= UINT32_C(1) << LED_PIN;
        }
        if (!reentry_is_silent()) {
            __asm volatile("wfi");
        }
    }
}
