/* A program under coboot: its start, its objects 1F51h, 1F56h and 1F57h, and its return to the
 * bootloader.
 *
 * It works with any CANopen stack: the stack calls coboot_program_read and coboot_program_write for
 * these objects.
 */
#ifndef COBOOT_PROGRAM_H
#define COBOOT_PROGRAM_H

#include <stdbool.h>
#include <stdint.h>

#include "coboot.h"
#include "reentry.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Objects with an element for each program of the device (CiA 302-3; SYS TEC manual, 3.4.1). */
#define COBOOT_PROGRAM_CONTROL 0x1F51
#define COBOOT_PROGRAM_ID 0x1F56
/* Date and time of this program: 1 days since 1984-01-01, 2 milliseconds after midnight (UTC); 0 if unknown (CiA 302-3). */
#define COBOOT_PROGRAM_DATE 0x1F52
#define COBOOT_FLASH_STATUS 0x1F57
/* Versions of the programs, an object of coboot. */
#define COBOOT_PROGRAM_VERSION 0x2005
/* Device state, an object of coboot; an application has its sub-index 1 alone: the sub-index that the bootloader itself
 * has in the objects above, 0 if it cannot be renewed over CAN.
 */
#define COBOOT_DEVICE_STATE 0x2007

/* The value of 1F51h that calls the bootloader (SYS TEC manual L-1112d_10, table 2). */
#define COBOOT_START_BOOTLOADER UINT32_C(0x80)

/* SDO abort codes (CiA 301 table 22). */
#define COBOOT_ABORT_NONE UINT32_C(0)
#define COBOOT_ABORT_READ_ONLY UINT32_C(0x06010002)
#define COBOOT_ABORT_NO_OBJECT UINT32_C(0x06020000)
#define COBOOT_ABORT_HARDWARE UINT32_C(0x06060000)
#define COBOOT_ABORT_NO_SUB_INDEX UINT32_C(0x06090011)
#define COBOOT_ABORT_VALUE UINT32_C(0x06090030)
#define COBOOT_ABORT_DEVICE_STATE UINT32_C(0x08000022)

struct coboot_program {
    /* Node-ID and bit rate at the start: the bootloader's if it left a handoff, otherwise the
     * arguments of coboot_program_init. Bit rate in bit/s, 0 for a device that detects it by
     * listening.
     */
    uint8_t node_id;
    uint32_t bit_rate;
    uint32_t serial_number;
    /* Vendor-ID, product code and revision of the device, or a null pointer for those of its board. */
    const struct coboot_nameplate *nameplate;
    /* The bases of the COB-IDs of SDO requests and answers, to which the node-ID is added. */
    uint16_t sdo_request_base;
    uint16_t sdo_response_base;
    /* The date of this program, in seconds since 1970-01-01 UTC; 0 if unknown. */
    uint32_t date;
    /* The number of the program in the device, from 1 on. */
    uint8_t number;
    /* Services of the bootloader, or a null pointer. */
    const struct coboot_callgate *gate;
    /* The rule of the application about leaving; set it after coboot_program_init. A null pointer:
     * it always may.
     *
     * It is asked once before a command of 1F51h, or a request of the application itself, ends in a
     * reset, and answers at once. False: the command is refused (COBOOT_ABORT_DEVICE_STATE), and
     * nothing has changed. True is final: the reset follows, 500 ms later at most, and until then
     * coboot_program_leaving is true: what stands must not start to move. An NMT reset is not
     * refused, and does not ask.
     *
     * An application that refuses for ever must not lock itself in. So the first refusal since its
     * start takes back that it is confirmed, which writes flash as coboot_store_node does: the next
     * start has the rescue window. Nothing is stored for a sealed program; it has the window after
     * an NMT reset.
     */
    bool (*may_leave)(void);

    /* Only program.c uses the rest. */
    uint32_t crc;
    /* The sub-index of the bootloader itself; 0 if it cannot be renewed over CAN. */
    uint8_t bootloader;
    /* The next 80h to this program confirms it. */
    bool fresh;
    /* After a refusal, the request with which an NMT reset leaves; otherwise 0. */
    uint32_t refused;
    /* The bootloader starts with this node-ID and bit rate, so that it can answer for this program.
     * Set it to false if the program changes one of them.
     */
    bool bootloader_answers;
    struct coboot_reentry reentry;
};

/* Reads the handoff and finds the callgate. Call it first, before CAN is set up. */
void coboot_program_init(struct coboot_program *program, uint8_t node_id, uint32_t bit_rate);

/* Reads an element of these objects, and its size in bytes, for an SDO upload.
 * COBOOT_ABORT_NO_OBJECT for every other index.
 */
uint32_t coboot_program_read(const struct coboot_program *program, uint16_t index, uint8_t sub, uint32_t *value,
                             uint8_t *size);

/* Handles an SDO download of the right size to one of these objects; one to 1F51h is a command.
 * Call it before the download is answered, and answer unless coboot_program_is_silent is true.
 * COBOOT_ABORT_DEVICE_STATE: the bootloader must be called first (80h), or the application may not
 * leave now.
 */
uint32_t coboot_program_write(struct coboot_program *program, uint16_t index, uint8_t sub, uint32_t value,
                              uint32_t now_ms);

/* Carries out NMT reset node, which is not refused (CiA 301): a reset that is not counted as a
 * crash. It comes as soon as all frames are on the bus.
 */
void coboot_program_nmt_reset(struct coboot_program *program, uint32_t now_ms);

/* The same reset as a request of the application itself. COBOOT_ABORT_DEVICE_STATE if it may not
 * leave now.
 */
uint32_t coboot_program_restart(struct coboot_program *program, uint32_t now_ms);

/* Confirms this program as a request of the application itself: it is good. Where the flash is
 * locked (a sealed program), the device restarts to store it, if it may leave. A program that has
 * refused to leave is released by this, but keeps its rescue window. COBOOT_ABORT_HARDWARE if the
 * bootloader does not store it, COBOOT_ABORT_DEVICE_STATE if the device may not leave now, or is
 * about to leave for another reason.
 */
uint32_t coboot_program_confirm(struct coboot_program *program, uint32_t now_ms);

/* Stores node-ID (255 for none) and bit rate in bit/s as a request of the application itself, with
 * a restart and the results of coboot_program_confirm.
 */
uint32_t coboot_program_store_node(struct coboot_program *program, uint8_t node_id, uint32_t bit_rate, uint32_t now_ms);

/* Call it in the main loop, in thread mode, at least once per millisecond. `quiet`: no answer waits
 * to be sent, and all mailboxes are empty. It resets the chip when it is time.
 */
void coboot_program_proceed(struct coboot_program *program, bool quiet, uint32_t now_ms);

/* Whether the program must take no request and send nothing any more; the bootloader answers the
 * last request.
 */
static inline bool coboot_program_is_silent(const struct coboot_program *program)
{
    return program->reentry.silent;
}

/* Whether the device is about to leave: what stands must not start to move. */
static inline bool coboot_program_leaving(const struct coboot_program *program)
{
    return program->reentry.phase != COBOOT_STAYS;
}

#ifdef __cplusplus
}
#endif
#endif
