#include "program.h"

/* Values of 1F51h (CiA 302-3 and the SYS TEC manual, 3.4.4). */
enum {
    STOP = 0,
    START = 1,
    RESET_STAT = 2,
    CLEAR = 3,
    START_BOOTLOADER = COBOOT_START_BOOTLOADER,
    SET_SIGNATURE = 0x83,
    CLR_SIGNATURE = 0x84,
};
/* Values that a read of 1F51h returns for a program (CiA 302-3). */
enum { STOPPED = 0, RUNNING = 1, ABSENT = 3 };

/* The seconds of a day, and those from the start of 1970 to that of 1984, the origin of dates in CANopen. */
#define DAY UINT32_C(86400)
#define START_OF_1984 (UINT32_C(5113) * DAY)

/* The number of the device's programs, from the value of a symbol of the linker. */
static uint8_t programs(void)
{
    extern const uint8_t __programs;
    return (uint8_t)(uintptr_t)&__programs;
}

void coboot_program_init(struct coboot_program *program, uint8_t node_id, uint32_t bit_rate)
{
    struct coboot_handoff handoff;
    struct coboot_program_args info;

    program->node_id = node_id;
    program->bit_rate = bit_rate;
    program->serial_number = 0;
    program->date = 0;
    program->nameplate = NULL;
    program->sdo_request_base = 0x600;
    program->sdo_response_base = 0x580;
    program->number = 1;
    program->bootloader = 0;
    program->fresh = false;
    program->refused = 0;
    program->may_leave = NULL;
    program->bootloader_answers = false;
    program->reentry.phase = COBOOT_STAYS;
    program->reentry.silent = false;
    if (coboot_read_handoff(&handoff)) {
        program->node_id = handoff.node_id;
        program->bit_rate = handoff.bit_rate;
        program->serial_number = handoff.serial_number;
        program->date = handoff.program_date;
        program->nameplate = coboot_nameplate(&handoff);
        program->sdo_request_base = coboot_sdo_request_base(&handoff);
        program->sdo_response_base = coboot_sdo_response_base(&handoff);
        program->number = handoff.program;
        program->bootloader = coboot_bootloader_number(&handoff);
        program->fresh = coboot_is_fresh(&handoff);
        /* A bootloader that detects its bit rate first has no time to answer. */
        program->bootloader_answers = handoff.bit_rate != 0;
    }
    program->gate = coboot_callgate();
    /* The CRC that the bootloader has verified, the same as in the bootloader. 0 if it knows of no
     * download.
     */
    const bool known =
        program->gate != NULL && coboot_program_info(program->gate, program->number, &info) == COBOOT_STATUS_OK;
    program->crc = known ? info.crc : 0;
}

uint32_t coboot_program_read(const struct coboot_program *program, uint16_t index, uint8_t sub, uint32_t *value,
                             uint8_t *size)
{
    struct coboot_program_args info;

    if (index == COBOOT_DEVICE_STATE) {
        *value = sub == 0 ? 1 : program->bootloader;
        *size = 1;
        return sub <= 1 ? COBOOT_ABORT_NONE : COBOOT_ABORT_NO_SUB_INDEX;
    }
    if (index == COBOOT_PROGRAM_DATE) {
        const uint32_t since_1984 = program->date >= START_OF_1984 ? program->date - START_OF_1984 : 0;
        *value = sub == 0 ? 2 : sub == 1 ? since_1984 / DAY : since_1984 % DAY * 1000;
        *size = sub == 0 ? 1 : 4;
        return sub <= 2 ? COBOOT_ABORT_NONE : COBOOT_ABORT_NO_SUB_INDEX;
    }
    if (index != COBOOT_PROGRAM_CONTROL && index != COBOOT_PROGRAM_ID && index != COBOOT_FLASH_STATUS
        && index != COBOOT_PROGRAM_VERSION) {
        return COBOOT_ABORT_NO_OBJECT;
    }
    /* To this program the bootloader is one that does not run. */
    const bool is_bootloader = sub != 0 && sub == program->bootloader;
    if (sub > programs() && !is_bootloader) {
        return COBOOT_ABORT_NO_SUB_INDEX;
    }
    if (sub == 0) {
        *value = program->bootloader != 0 ? program->bootloader : programs();
        *size = 1;
        return COBOOT_ABORT_NONE;
    }
    const bool own = sub == program->number;
    const uint32_t number = is_bootloader ? COBOOT_BOOTLOADER : sub;
    const bool asks = !own || index == COBOOT_PROGRAM_VERSION;
    const bool installed = asks && program->gate != NULL
        && coboot_program_info(program->gate, number, &info) == COBOOT_STATUS_OK
        && (info.flags & COBOOT_PROGRAM_INSTALLED) != 0;
    *size = index == COBOOT_PROGRAM_CONTROL ? 1 : 4;
    if (index == COBOOT_PROGRAM_CONTROL) {
        *value = own ? RUNNING : installed ? STOPPED : ABSENT;
    } else if (index == COBOOT_PROGRAM_ID) {
        *value = own ? program->crc : installed ? info.crc : 0;
    } else if (index == COBOOT_PROGRAM_VERSION) {
        *value = installed ? info.version : 0;
    } else {
        *value = 0;
    }
    return COBOOT_ABORT_NONE;
}

static uint32_t leave(struct coboot_program *program, uint32_t request, uint32_t argument, uint32_t now_ms)
{
    const bool possible = coboot_reentry_begin(&program->reentry, request, argument, now_ms);
    return possible ? COBOOT_ABORT_NONE : COBOOT_ABORT_DEVICE_STATE;
}

/* The answer of the application. A device that is leaving is not asked again. */
static bool may_leave(const struct coboot_program *program)
{
    return coboot_program_leaving(program) || program->may_leave == NULL || program->may_leave();
}

/* A request of the application itself. */
static uint32_t leave_if_allowed(struct coboot_program *program, uint32_t request, uint32_t argument, uint32_t now_ms)
{
    return may_leave(program) ? leave(program, request, argument, now_ms) : COBOOT_ABORT_DEVICE_STATE;
}

/* The refusal of a master's command. The next start has the rescue window. */
static uint32_t refuse(struct coboot_program *program)
{
    /* Stored once since the start: whoever asks for ever wears nothing out. */
    if (program->refused != COBOOT_REQUEST_RESCUE) {
        const int32_t status =
            program->gate != NULL ? coboot_unconfirm(program->gate, program->number) : COBOOT_STATUS_FAILED;
        const bool is_known = status == COBOOT_STATUS_OK || status == COBOOT_STATUS_LOCKED;
        /* A bootloader without this service would take the request for a crash. */
        program->refused = is_known ? COBOOT_REQUEST_RESCUE : COBOOT_REQUEST_POWER_ON;
    }
    return COBOOT_ABORT_DEVICE_STATE;
}

/* A command of a master. */
static uint32_t leave_for_master(struct coboot_program *program, uint32_t request, uint32_t argument, uint32_t now_ms)
{
    return may_leave(program) ? leave(program, request, argument, now_ms) : refuse(program);
}

uint32_t coboot_program_confirm(struct coboot_program *program, uint32_t now_ms)
{
    const bool keeps_window = program->refused == COBOOT_REQUEST_RESCUE;
    struct coboot_program_args info;

    if (program->gate == NULL) {
        program->fresh = false;
        return COBOOT_ABORT_HARDWARE;
    }
    if (keeps_window && coboot_program_info(program->gate, program->number, &info) == COBOOT_STATUS_OK
        && (info.flags & COBOOT_PROGRAM_SIGNED) != 0) {
        program->fresh = false;
        return COBOOT_ABORT_NONE;
    }
    const int32_t status = coboot_confirm(program->gate, program->number);
    if (status == COBOOT_STATUS_LOCKED) {
        /* The bootloader stores it. Until then another 80h has the same meaning. */
        return leave_if_allowed(program, COBOOT_REQUEST_CONFIRM, program->number, now_ms);
    }
    program->fresh = false;
    if (status == COBOOT_STATUS_OK && keeps_window) {
        (void)coboot_unconfirm(program->gate, program->number);
    }
    return status == COBOOT_STATUS_OK ? COBOOT_ABORT_NONE : COBOOT_ABORT_HARDWARE;
}

/* Handles the first 80h after a download and start in one go: masters that do not know SYS TEC's
 * commands confirm the program with it.
 */
static uint32_t confirm_for_master(struct coboot_program *program, uint32_t now_ms)
{
    const uint32_t abort_code = coboot_program_confirm(program, now_ms);
    const bool refuses = abort_code == COBOOT_ABORT_DEVICE_STATE && !coboot_program_leaving(program);
    return refuses ? refuse(program) : abort_code;
}

uint32_t coboot_program_store_node(struct coboot_program *program, uint8_t node_id, uint32_t bit_rate, uint32_t now_ms)
{
    const int32_t status =
        program->gate != NULL ? coboot_store_node(program->gate, node_id, bit_rate) : COBOOT_STATUS_FAILED;
    if (status == COBOOT_STATUS_LOCKED) {
        return leave_if_allowed(program, COBOOT_REQUEST_STORE_NODE, coboot_stored_node(node_id, bit_rate), now_ms);
    }
    return status == COBOOT_STATUS_OK ? COBOOT_ABORT_NONE : COBOOT_ABORT_HARDWARE;
}

uint32_t coboot_program_write(struct coboot_program *program, uint16_t index, uint8_t sub, uint32_t value,
                              uint32_t now_ms)
{
    uint32_t before;
    uint8_t size;

    const uint32_t abort_code = coboot_program_read(program, index, sub, &before, &size);
    if (abort_code != COBOOT_ABORT_NONE) {
        return abort_code;
    }
    if (index != COBOOT_PROGRAM_CONTROL || sub == 0) {
        return COBOOT_ABORT_READ_ONLY;
    }
    const bool own = sub == program->number;
    if (value == STOP && sub == program->bootloader) {
        return COBOOT_ABORT_NONE; /* It does not run. */
    }
    switch (value) {
    case START_BOOTLOADER:
        return own && program->fresh ? confirm_for_master(program, now_ms)
                                     : leave_for_master(program, COBOOT_REQUEST_STAY, 0, now_ms);
    case STOP:  /* The bootloader runs instead. */
    case CLEAR: /* The bootloader carries it out. */
        /* Masters send the next request at once after the answer, so the bootloader must send this
         * answer. If it cannot, STOP is a call, which it counts (node-ID 0).
         */
        if (program->bootloader_answers || value == STOP) {
            const uint8_t node_id = program->bootloader_answers ? program->node_id : 0;
            const uint32_t owed = coboot_owed(sub, (uint8_t)value, node_id);
            return leave_for_master(program, COBOOT_REQUEST_OWED, owed, now_ms);
        }
        return COBOOT_ABORT_DEVICE_STATE;
    case RESET_STAT: /* CiA 302-3: reset program, which starts it anew. */
        return own ? leave_for_master(program, COBOOT_REQUEST_START, sub, now_ms) : COBOOT_ABORT_DEVICE_STATE;
    case START: /* It runs already; another one is the bootloader's to start. */
        return own ? COBOOT_ABORT_NONE : COBOOT_ABORT_DEVICE_STATE;
    case SET_SIGNATURE:
    case CLR_SIGNATURE: /* The bootloader's to do. */
        return COBOOT_ABORT_DEVICE_STATE;
    default:
        return COBOOT_ABORT_VALUE;
    }
}

void coboot_program_nmt_reset(struct coboot_program *program, uint32_t now_ms)
{
    const uint32_t request = program->refused != 0 ? program->refused : COBOOT_REQUEST_POWER_ON;

    /* An earlier promise to a master has priority; it leads to a reset, too. */
    (void)coboot_reentry_begin(&program->reentry, request, 0, now_ms);
}

uint32_t coboot_program_restart(struct coboot_program *program, uint32_t now_ms)
{
    if (!may_leave(program)) {
        return COBOOT_ABORT_DEVICE_STATE;
    }
    coboot_program_nmt_reset(program, now_ms);
    return COBOOT_ABORT_NONE;
}

void coboot_program_proceed(struct coboot_program *program, bool quiet, uint32_t now_ms)
{
    if (coboot_reentry_proceed(&program->reentry, quiet, now_ms) == COBOOT_LEAVE) {
        coboot_reset(program->reentry.request, program->reentry.argument);
    }
}
