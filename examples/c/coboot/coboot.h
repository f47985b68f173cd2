/* What coboot and an application in C must agree on. A test holds its numbers against the library for Rust, shared-abi.
 *
 * C11 or C++17, freestanding, no library. Addresses come from the linker: `cargo xtask layout --ld program-1` prints the
 * symbols __handoff, __warm_start and __callgate_table of a board. The functions that need the chip are there when
 * the compiler's target is Arm; the rest works on any machine.
 */
#ifndef COBOOT_H
#define COBOOT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* What C and C++ spell differently. */
#ifdef __cplusplus
#define COBOOT_STATIC_ASSERT static_assert
#define COBOOT_NORETURN [[noreturn]]
extern "C" {
#else
#define COBOOT_STATIC_ASSERT _Static_assert
#define COBOOT_NORETURN _Noreturn
#endif

/* The check word that guards a record in RAM: it distinguishes a record and the noise of unpowered RAM. */

#define COBOOT_CHECK_SEED UINT32_C(0xC0B007A5)
#define COBOOT_CHECK_ROTATION UINT32_C(0x5)
#define COBOOT_CHECK_FACTOR UINT32_C(0x9E3779B1)

/* Over so many words. They are put together from bytes: records have smaller fields, too. */
static inline uint32_t coboot_check_word(const void *record, size_t words)
{
    const unsigned char *byte = (const unsigned char *)record;
    uint32_t fold = COBOOT_CHECK_SEED;
    for (size_t i = 0; i < words; i++, byte += 4) {
        uint32_t word = byte[0] | (uint32_t)byte[1] << 8 | (uint32_t)byte[2] << 16 | (uint32_t)byte[3] << 24;
        fold = (fold << COBOOT_CHECK_ROTATION | fold >> (32 - COBOOT_CHECK_ROTATION)) ^ word;
        fold *= COBOOT_CHECK_FACTOR;
    }
    return ~fold;
}

/* The step of that function for one word, for constants. (The product has `fold` twice side by side, so that a shift
 * rotates it.)
 */
#define COBOOT_FOLD(fold, word) \
    (((uint32_t)((fold) * UINT64_C(0x100000001) >> (32 - COBOOT_CHECK_ROTATION)) ^ (uint32_t)(word)) \
     * COBOOT_CHECK_FACTOR)

/* ---- The label: whom the image is for, so that coflash and the bootloader refuse it for another device ---- */

#define COBOOT_LABEL_MAGIC UINT32_C(0x314C4243)

struct coboot_label {
    uint32_t magic;
    uint32_t vendor_id;
    uint32_t product_code;
    uint32_t version;
    uint32_t date;
    uint32_t reserved[2];
    uint32_t check;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_label) == 32, "coboot_label");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, magic) == 0, "coboot_label: magic");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, vendor_id) == 4, "coboot_label: vendor_id");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, product_code) == 8, "coboot_label: product_code");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, version) == 12, "coboot_label: version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, date) == 16, "coboot_label: date");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, reserved) == 20, "coboot_label: reserved");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_label, check) == 28, "coboot_label: check");

/* The label of this image, once in a program: COBOOT_LABEL(vendor-ID, product code, version). The first two are those of
 * 1018h; 0 is any. The linker script puts the section `.label` at the symbol __label, after the vectors.
 * COBOOT_DATED_LABEL also takes the date of the program, in seconds since 1970-01-01 UTC, which 1F52h shows.
 */
#define COBOOT_LABEL(vendor_id, product_code, version) COBOOT_DATED_LABEL(vendor_id, product_code, version, 0)
#define COBOOT_DATED_LABEL(vendor_id, product_code, version, date) \
    __attribute__((section(".label"), used)) const struct coboot_label coboot_label_of_image = { \
        COBOOT_LABEL_MAGIC, (vendor_id), (product_code), (version), (date), { 0, 0 }, \
        COBOOT_LABEL_CHECK(vendor_id, product_code, version, date) \
    }
#define COBOOT_LABEL_CHECK(vendor_id, product_code, version, date) \
    (~COBOOT_FOLD(COBOOT_FOLD(COBOOT_FOLD(COBOOT_FOLD(COBOOT_FOLD(COBOOT_FOLD(COBOOT_FOLD( \
        COBOOT_CHECK_SEED, COBOOT_LABEL_MAGIC), vendor_id), product_code), version), date), 0), 0))
extern const struct coboot_label coboot_label_of_image;

/* ---- The warm-start cell: what the application asks of the bootloader across a reset ---- */

#define COBOOT_WARM_START_MAGIC UINT32_C(0x31574243)

/* Requests. Those for a program take its number, 1 to 254, as argument, an owed answer what coboot_owed makes, node
 * parameters what coboot_stored_node makes, and the others 0. Confirm, invalidate and store node
 * are for what the callgate answers with COBOOT_STATUS_LOCKED. Rescue starts as after a power-on,
 * with the rescue window. A bootloader that does not know a request counts a crash: send no others. */
#define COBOOT_REQUEST_STAY UINT32_C(0x1)
#define COBOOT_REQUEST_TRIAL UINT32_C(0x2)
#define COBOOT_REQUEST_START UINT32_C(0x3)
#define COBOOT_REQUEST_POWER_ON UINT32_C(0x5)
#define COBOOT_REQUEST_OWED UINT32_C(0x7)
#define COBOOT_REQUEST_CONFIRM UINT32_C(0xA)
#define COBOOT_REQUEST_INVALIDATE UINT32_C(0xB)
#define COBOOT_REQUEST_STORE_NODE UINT32_C(0xC)
#define COBOOT_REQUEST_RESCUE UINT32_C(0x10)

struct coboot_warm_start {
    uint32_t magic;
    uint32_t request;
    uint32_t argument;
    uint32_t check;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_warm_start) == 16, "coboot_warm_start");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_warm_start, magic) == 0, "coboot_warm_start: magic");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_warm_start, request) == 4, "coboot_warm_start: request");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_warm_start, argument) == 8, "coboot_warm_start: argument");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_warm_start, check) == 12, "coboot_warm_start: check");

/* The argument of COBOOT_REQUEST_OWED: node `node_id` was written `value` (0 STOP or 3 CLEAR) to 1F51h, sub-index `program`,
 * and has not answered. The bootloader serves the request after its boot-up, if it comes up with this node-ID. 0: the
 * program has answered STOP itself, and the bootloader counts it as its own.
 */
static inline uint32_t coboot_owed(uint8_t program, uint8_t value, uint8_t node_id)
{
    return program | (uint32_t)value << 8 | (uint32_t)node_id << 16;
}

/* The node-ID in it. */
static inline uint8_t coboot_owed_node(uint32_t argument)
{
    return (uint8_t)(argument >> 16);
}

/* The argument of COBOOT_REQUEST_STORE_NODE: node-ID (255 for none) and bit rate in bit/s, as in coboot_store_node. */
static inline uint32_t coboot_stored_node(uint8_t node_id, uint32_t bit_rate)
{
    return node_id | (bit_rate / 5000 & UINT32_C(0xFF)) << 8;
}

/* The cell that carries a request. */
static inline struct coboot_warm_start coboot_request(uint32_t request, uint32_t argument)
{
    struct coboot_warm_start cell = { COBOOT_WARM_START_MAGIC, request, argument, 0 };
    cell.check = coboot_check_word(&cell, offsetof(struct coboot_warm_start, check) / sizeof(uint32_t));
    return cell;
}

/* ---- The handoff: how the device came up ---- */

#define COBOOT_HANDOFF_MAGIC UINT32_C(0x4F484243)
#define COBOOT_HANDOFF_VERSION UINT32_C(0x5)
#define COBOOT_HANDOFF_OLDEST UINT32_C(0x1)

/* In `flags`, since version 2: the program was started right after its download in one go. */
#define COBOOT_HANDOFF_FRESH UINT32_C(0x1)
/* In `flags`, since version 5: the identity of the device is that of its nameplate. */
#define COBOOT_HANDOFF_NAMEPLATE UINT32_C(0x2)

/* Reset causes. */
#define COBOOT_RESET_UNKNOWN UINT32_C(0x0)
#define COBOOT_RESET_POWER_ON UINT32_C(0x1)
#define COBOOT_RESET_PIN UINT32_C(0x2)
#define COBOOT_RESET_SOFTWARE UINT32_C(0x3)
#define COBOOT_RESET_INDEPENDENT_WATCHDOG UINT32_C(0x4)
#define COBOOT_RESET_WINDOW_WATCHDOG UINT32_C(0x5)
#define COBOOT_RESET_LOW_POWER UINT32_C(0x6)
#define COBOOT_RESET_BROWN_OUT UINT32_C(0x7)
#define COBOOT_RESET_STANDBY UINT32_C(0x8)

struct coboot_handoff {
    uint32_t magic;
    uint16_t version;
    uint16_t length;
    uint8_t node_id;
    uint8_t program;
    uint8_t reset_cause;
    uint8_t trial;
    uint32_t bit_rate;
    uint32_t bootloader_version;
    uint32_t serial_number;
    uint32_t flags;
    uint32_t bootloader_number;
    uint16_t sdo_request_base;
    uint16_t sdo_response_base;
    uint32_t program_date;
    uint32_t reserved;
    uint32_t check;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_handoff) == 48, "coboot_handoff");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, magic) == 0, "coboot_handoff: magic");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, version) == 4, "coboot_handoff: version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, length) == 6, "coboot_handoff: length");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, node_id) == 8, "coboot_handoff: node_id");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, program) == 9, "coboot_handoff: program");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, reset_cause) == 10, "coboot_handoff: reset_cause");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, trial) == 11, "coboot_handoff: trial");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, bit_rate) == 12, "coboot_handoff: bit_rate");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, bootloader_version) == 16, "coboot_handoff: bootloader_version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, serial_number) == 20, "coboot_handoff: serial_number");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, flags) == 24, "coboot_handoff: flags");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, bootloader_number) == 28, "coboot_handoff: bootloader_number");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, sdo_request_base) == 32, "coboot_handoff: sdo_request_base");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, sdo_response_base) == 34, "coboot_handoff: sdo_response_base");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, program_date) == 36, "coboot_handoff: program_date");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, reserved) == 40, "coboot_handoff: reserved");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, check) == 44, "coboot_handoff: check");

/* Whether a bootloader wrote it, and it is whole. Later versions only give names to reserved words. */
static inline bool coboot_handoff_is_sound(const struct coboot_handoff *handoff)
{
    const size_t guarded = offsetof(struct coboot_handoff, check) / sizeof(uint32_t);
    return handoff->magic == COBOOT_HANDOFF_MAGIC && handoff->version >= COBOOT_HANDOFF_OLDEST
        && handoff->length == sizeof *handoff && handoff->node_id >= 1 && handoff->node_id <= 127
        && handoff->check == coboot_check_word(handoff, guarded);
}

/* Whether the program was started right after its download as raw image, Intel HEX or sealed image: the first 1F51h = 80h
 * confirms it then, and does not call the bootloader.
 */
static inline bool coboot_is_fresh(const struct coboot_handoff *handoff)
{
    return (handoff->flags & COBOOT_HANDOFF_FRESH) != 0;
}

/* The sub-index of the bootloader itself in 1F51h, 1F56h and 1F57h; 0 if it cannot be renewed over CAN. */
static inline uint8_t coboot_bootloader_number(const struct coboot_handoff *handoff)
{
    return handoff->bootloader_number <= UINT8_MAX ? (uint8_t)handoff->bootloader_number : 0;
}

/* The bases of the COB-IDs of SDO requests and answers, to which the node-ID is added: of a bootloader that knows none,
 * those of the predefined connection set (CiA 301 table 69).
 */
static inline bool coboot_has_sdo_bases(const struct coboot_handoff *handoff)
{
    return handoff->sdo_request_base >= 0x80 && handoff->sdo_request_base <= 0x780
        && handoff->sdo_response_base >= 0x80 && handoff->sdo_response_base <= 0x780;
}

static inline uint16_t coboot_sdo_request_base(const struct coboot_handoff *handoff)
{
    return coboot_has_sdo_bases(handoff) ? handoff->sdo_request_base : 0x600;
}

static inline uint16_t coboot_sdo_response_base(const struct coboot_handoff *handoff)
{
    return coboot_has_sdo_bases(handoff) ? handoff->sdo_response_base : 0x580;
}

/* ---- The nameplate: the identity of a device in the one-time programmable (OTP) bytes of its chip ---- */

#define COBOOT_NAMEPLATE_MAGIC UINT32_C(0x504E4243)

/* The OTP bytes of every STM32F4, and their blocks, each of the size of a nameplate. */
#define COBOOT_OTP UINT32_C(0x1FFF7800)
#define COBOOT_OTP_BLOCKS UINT32_C(0x10)

struct coboot_nameplate {
    uint32_t magic;
    uint32_t vendor_id;
    uint32_t product_code;
    uint32_t revision;
    uint32_t serial_number;
    uint32_t reserved[2];
    uint32_t check;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_nameplate) == 32, "coboot_nameplate");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, magic) == 0, "coboot_nameplate: magic");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, vendor_id) == 4, "coboot_nameplate: vendor_id");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, product_code) == 8, "coboot_nameplate: product_code");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, revision) == 12, "coboot_nameplate: revision");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, serial_number) == 16, "coboot_nameplate: serial_number");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, reserved) == 20, "coboot_nameplate: reserved");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_nameplate, check) == 28, "coboot_nameplate: check");

/* Whether a block has a good nameplate. Later ones may give names to the reserved words. */
static inline bool coboot_nameplate_is_sound(const struct coboot_nameplate *plate)
{
    const size_t guarded = offsetof(struct coboot_nameplate, check) / sizeof(uint32_t);
    return plate->magic == COBOOT_NAMEPLATE_MAGIC && plate->check == coboot_check_word(plate, guarded);
}

/* The nameplate in these COBOOT_OTP_BLOCKS blocks: the last good one, or a null pointer. */
static inline const struct coboot_nameplate *coboot_last_nameplate(const struct coboot_nameplate *otp)
{
    for (size_t block = COBOOT_OTP_BLOCKS; block-- > 0;) {
        if (coboot_nameplate_is_sound(&otp[block])) {
            return &otp[block];
        }
    }
    return NULL;
}

/* ---- The callgate: services of the bootloader that an application calls like a function ----
 *
 * One at a time, from one priority, with the flash controller left alone meanwhile. It uses the caller's stack alone,
 * and no FPU. What stores keeps the core from its flash for 16 us at a time; no call erases a sector. A CRC holds interrupts
 * back for some 50 us at a time at 16 MHz, so they may use the CRC unit, too.
 */

#define COBOOT_CALLGATE_MAGIC UINT32_C(0x47434243)
#define COBOOT_CALLGATE_ABI_VERSION UINT32_C(0x1)
#define COBOOT_CALLGATE_TABLE_SIZE UINT32_C(0x10)

/* Bytes of the caller's stack that a call may use. */
#define COBOOT_CALLGATE_STACK UINT32_C(0x400)

struct coboot_callgate {
    uint32_t magic;
    uint16_t abi_version;
    uint16_t length;
    uint32_t bootloader_version;
    uint32_t entry;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_callgate) == 16, "coboot_callgate");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, magic) == 0, "coboot_callgate: magic");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, abi_version) == 4, "coboot_callgate: abi_version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, length) == 6, "coboot_callgate: length");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, bootloader_version) == 8, "coboot_callgate: bootloader_version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, entry) == 12, "coboot_callgate: entry");

/* What can be called. */
#define COBOOT_SELECTOR_CRC32 UINT32_C(0x1)
#define COBOOT_SELECTOR_READ_NODE UINT32_C(0x2)
#define COBOOT_SELECTOR_STORE_NODE UINT32_C(0x3)
#define COBOOT_SELECTOR_PROGRAM_INFO UINT32_C(0x4)
#define COBOOT_SELECTOR_CONFIRM UINT32_C(0x5)
#define COBOOT_SELECTOR_INVALIDATE UINT32_C(0x6)
#define COBOOT_SELECTOR_UNCONFIRM UINT32_C(0x7)

/* COBOOT_SELECTOR_CRC32: from `address` on, any alignment, `len` bytes of flash; gives `crc`. */
struct coboot_crc32_args {
    uint32_t address;
    uint32_t len;
    uint32_t crc;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_crc32_args) == 12, "coboot_crc32_args");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_crc32_args, address) == 0, "coboot_crc32_args: address");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_crc32_args, len) == 4, "coboot_crc32_args: len");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_crc32_args, crc) == 8, "coboot_crc32_args: crc");

/* COBOOT_SELECTOR_READ_NODE and _STORE_NODE: node-ID 1 to 127, or 255 for none; bit rate in bit/s, 0 for one to be found
 * out by listening. */
struct coboot_node_args {
    uint32_t node_id;
    uint32_t bit_rate;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_node_args) == 8, "coboot_node_args");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_node_args, node_id) == 0, "coboot_node_args: node_id");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_node_args, bit_rate) == 4, "coboot_node_args: bit_rate");

/* COBOOT_SELECTOR_PROGRAM_INFO, _CONFIRM, _INVALIDATE and _UNCONFIRM: about program `number`; the first gives the rest. */
struct coboot_program_args {
    uint32_t number;
    uint32_t size;
    uint32_t crc;
    uint32_t version;
    uint32_t flags;
};
COBOOT_STATIC_ASSERT(sizeof(struct coboot_program_args) == 20, "coboot_program_args");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_program_args, number) == 0, "coboot_program_args: number");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_program_args, size) == 4, "coboot_program_args: size");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_program_args, crc) == 8, "coboot_program_args: crc");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_program_args, version) == 12, "coboot_program_args: version");
COBOOT_STATIC_ASSERT(offsetof(struct coboot_program_args, flags) == 16, "coboot_program_args: flags");

/* The number of the bootloader itself. */
#define COBOOT_BOOTLOADER UINT32_C(0xFF)

/* In `flags`: downloaded completely and right; signed, so that it starts by itself. */
#define COBOOT_PROGRAM_INSTALLED UINT32_C(0x1)
#define COBOOT_PROGRAM_SIGNED UINT32_C(0x2)

/* What a call returns. */
#define COBOOT_STATUS_OK INT32_C(0) /* done */
#define COBOOT_STATUS_UNKNOWN_SELECTOR INT32_C(-1) /* this bootloader has no such selector */
#define COBOOT_STATUS_BAD_POINTER INT32_C(-2) /* the argument pointer is null, misaligned or not in RAM */
#define COBOOT_STATUS_BAD_RANGE INT32_C(-3) /* the range does not lie in flash, or is empty */
#define COBOOT_STATUS_BUSY INT32_C(-4) /* somebody uses the flash controller */
#define COBOOT_STATUS_FAILED INT32_C(-5) /* the flash did not take the value */
#define COBOOT_STATUS_BAD_ARGUMENT INT32_C(-6) /* a node-ID, bit rate or program number that does not exist here */
#define COBOOT_STATUS_NO_PROGRAM INT32_C(-7) /* nothing is installed under this number */
#define COBOOT_STATUS_LOCKED INT32_C(-8) /* the flash is locked: leave with COBOOT_REQUEST_CONFIRM or the like */
#define COBOOT_STATUS_FULL INT32_C(-9) /* the journal is nearly full: the next start without a request makes room */

/* Whether the application understands a callgate. */
enum coboot_callgate_state {
    COBOOT_CALLGATE_GOOD,          /* it may be called */
    COBOOT_CALLGATE_ABSENT,        /* another bootloader, or none */
    COBOOT_CALLGATE_OTHER_VERSION, /* a bootloader of coboot with another ABI: its `abi_version` */
};

static inline enum coboot_callgate_state coboot_callgate_state(const struct coboot_callgate *gate)
{
    if (gate->magic != COBOOT_CALLGATE_MAGIC || gate->length < COBOOT_CALLGATE_TABLE_SIZE) {
        return COBOOT_CALLGATE_ABSENT;
    }
    return gate->abi_version >= COBOOT_CALLGATE_ABI_VERSION ? COBOOT_CALLGATE_GOOD : COBOOT_CALLGATE_OTHER_VERSION;
}

#if defined(__arm__)

extern const struct coboot_callgate __callgate_table;
extern volatile struct coboot_handoff __handoff;
extern volatile struct coboot_warm_start __warm_start;

/* Copies the handoff. False where no bootloader left a sound one (a debugger started the application, say). */
static inline bool coboot_read_handoff(struct coboot_handoff *handoff)
{
    const volatile unsigned char *from = (const volatile unsigned char *)&__handoff;
    unsigned char *to = (unsigned char *)handoff;
    for (size_t i = 0; i < sizeof *handoff; i++) {
        to[i] = from[i];
    }
    return coboot_handoff_is_sound(handoff);
}

/* The nameplate of the device, which the program must show in 1018h as the bootloader does: serial_number is the handoff's.
 * A null pointer where the identity is that of the board.
 */
static inline const struct coboot_nameplate *coboot_nameplate(const struct coboot_handoff *handoff)
{
    const bool there = (handoff->flags & COBOOT_HANDOFF_NAMEPLATE) != 0;
    return there ? coboot_last_nameplate((const struct coboot_nameplate *)(uintptr_t)COBOOT_OTP) : NULL;
}

/* The callgate of the bootloader underneath, or a null pointer. */
static inline const struct coboot_callgate *coboot_callgate(void)
{
    const struct coboot_callgate *gate = &__callgate_table;
    return coboot_callgate_state(gate) == COBOOT_CALLGATE_GOOD ? gate : NULL;
}

/* Calls a service of a callgate that was found, with the structure of its selector. */
static inline int32_t coboot_call(const struct coboot_callgate *gate, uint32_t selector, void *args)
{
    typedef int32_t (*entry)(uint32_t selector, void *args);
    return ((entry)(uintptr_t)gate->entry)(selector, args);
}

/* CRC-32/ISO-HDLC over flash: the function of 1F56h. */
static inline int32_t coboot_crc32(const struct coboot_callgate *gate, uint32_t address, uint32_t len, uint32_t *crc)
{
    struct coboot_crc32_args args = { address, len, 0 };
    int32_t status = coboot_call(gate, COBOOT_SELECTOR_CRC32, &args);
    *crc = args.crc;
    return status;
}

/* Node-ID and bit rate as they are stored. */
static inline int32_t coboot_read_node(const struct coboot_callgate *gate, struct coboot_node_args *node)
{
    return coboot_call(gate, COBOOT_SELECTOR_READ_NODE, node);
}

/* Stores node-ID and bit rate; they are in force from the next reset on. */
static inline int32_t coboot_store_node(const struct coboot_callgate *gate, uint32_t node_id, uint32_t bit_rate)
{
    struct coboot_node_args args = { node_id, bit_rate };
    return coboot_call(gate, COBOOT_SELECTOR_STORE_NODE, &args);
}

/* What is known of a program, or with COBOOT_BOOTLOADER of the bootloader itself where it can be renewed over CAN. */
static inline int32_t coboot_program_info(const struct coboot_callgate *gate, uint32_t number,
                                          struct coboot_program_args *info)
{
    info->number = number;
    return coboot_call(gate, COBOOT_SELECTOR_PROGRAM_INFO, info);
}

/* Gives a program its signature: how a trial confirms itself. */
static inline int32_t coboot_confirm(const struct coboot_callgate *gate, uint32_t number)
{
    struct coboot_program_args args = { number, 0, 0, 0, 0 };
    return coboot_call(gate, COBOOT_SELECTOR_CONFIRM, &args);
}

/* Takes a program's signature away: it does not start by itself any more. */
static inline int32_t coboot_invalidate(const struct coboot_callgate *gate, uint32_t number)
{
    struct coboot_program_args args = { number, 0, 0, 0, 0 };
    return coboot_call(gate, COBOOT_SELECTOR_INVALIDATE, &args);
}

/* Takes back that a program is confirmed, but not its signature: it starts with its rescue window.
 * COBOOT_STATUS_LOCKED for a sealed program, COBOOT_STATUS_UNKNOWN_SELECTOR of an older bootloader.
 */
static inline int32_t coboot_unconfirm(const struct coboot_callgate *gate, uint32_t number)
{
    struct coboot_program_args args = { number, 0, 0, 0, 0 };
    return coboot_call(gate, COBOOT_SELECTOR_UNCONFIRM, &args);
}

/* Leaves a request for the bootloader and resets the chip. What asked for it is answered before: wait until the answer is
 * on the bus, then 10 ms in which requests are served. Who leaves with COBOOT_REQUEST_OWED and a
 * node-ID does so at once, and has not answered.
 */
COBOOT_NORETURN static inline void coboot_reset(uint32_t request, uint32_t argument)
{
    const struct coboot_warm_start cell = coboot_request(request, argument);
    __asm volatile("cpsid i" ::: "memory");
    __warm_start.magic = cell.magic;
    __warm_start.request = cell.request;
    __warm_start.argument = cell.argument;
    __warm_start.check = cell.check;
    __asm volatile("dsb" ::: "memory");
    /* AIRCR: the key, SYSRESETREQ, and the priority grouping as it is (ARMv7-M B3.2.6). */
    volatile uint32_t *aircr = (volatile uint32_t *)UINT32_C(0xE000ED0C);
    *aircr = (*aircr & UINT32_C(0x700)) | UINT32_C(0x05FA0004);
    for (;;) {
    }
}

#endif

#ifdef __cplusplus
}
#endif
#endif
