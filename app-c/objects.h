/* The object dictionary: what an SDO server reads and writes. */
#ifndef OBJECTS_H
#define OBJECTS_H

#include <stddef.h>
#include <stdint.h>

#include "coboot/program.h"

#ifdef __cplusplus
extern "C" {
#endif

/* SDO abort codes (CiA 301 table 22) besides those of coboot/program.h. */
#define ABORT_COMMAND UINT32_C(0x05040001)
#define ABORT_LENGTH UINT32_C(0x06070010)

/* A number that clients read, and may write where there is a function for it, which gives an abort code or COBOOT_ABORT_NONE. */
struct object {
    uint16_t index;
    uint8_t sub;
    /* In bytes: 1, 2 or 4. */
    uint8_t size;
    uint32_t *value;
    uint32_t (*write)(uint8_t sub, uint32_t value);
};

/* The application has these two: what coboot knows of it, with 1F51h, 1F56h and 1F57h; and all other objects, the last one
 * zeros.
 */
extern struct coboot_program program;
extern const struct object objects[];
/* Objects that another file adds, the last one zeros. There need not be any. */
extern const struct object more_objects[] __attribute__((weak));

/* The value of an element and its size in bytes; gives an abort code, or COBOOT_ABORT_NONE. */
uint32_t object_read(uint16_t index, uint8_t sub, uint32_t *value, uint8_t *size);
/* Writes `len` bytes: 0 where the client does not say how many, more than 4 where they do not come in one frame. */
uint32_t object_write(uint16_t index, uint8_t sub, uint32_t value, size_t len);

#ifdef __cplusplus
}
#endif
#endif
