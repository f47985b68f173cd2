/* The object dictionary, for an SDO server. */
#ifndef OBJECTS_H
#define OBJECTS_H

#include <stddef.h>
#include <stdint.h>

#include "coboot/program.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Further SDO abort codes (CiA 301 table 22), in addition to those of coboot/program.h. */
#define ABORT_COMMAND UINT32_C(0x05040001)
#define ABORT_LENGTH UINT32_C(0x06070010)

/* A number that clients can read. They can write it if there is a function for that, which returns
 * an abort code or COBOOT_ABORT_NONE.
 */
struct object {
    uint16_t index;
    uint8_t sub;
    /* The size in bytes: 1, 2 or 4. */
    uint8_t size;
    uint32_t *value;
    uint32_t (*write)(uint8_t sub, uint32_t value);
};

/* The application defines these three: coboot's state of the program, with 1F51h, 1F56h and 1F57h;
 * all other objects, the last one zeros; and the callback of a download to 1F51h.
 */
extern struct coboot_program program;
extern const struct object objects[];
uint32_t app_cb_program_ctrl(uint8_t sub, uint32_t value);
/* Further objects from another file, the last one zeros. They are optional. */
extern const struct object more_objects[] __attribute__((weak));

/* Reads the value of an element and its size in bytes; returns an abort code, or COBOOT_ABORT_NONE.
 */
uint32_t object_read(uint16_t index, uint8_t sub, uint32_t *value, uint8_t *size);
/* Writes `len` bytes: 0 if the client does not give the number, more than 4 if they do not fit one
 * frame.
 */
uint32_t object_write(uint16_t index, uint8_t sub, uint32_t value, size_t len);

#ifdef __cplusplus
}
#endif
#endif
