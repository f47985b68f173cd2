#include "objects.h"

#include "board.h"

/* Finds an object in one of the tables. */
static uint32_t find(uint16_t index, uint8_t sub, const struct object **found)
{
    const struct object *const tables[] = { objects, more_objects };
    uint32_t abort_code = COBOOT_ABORT_NO_OBJECT;

    for (unsigned i = 0; i < 2; i++) {
        for (const struct object *object = tables[i]; object != NULL && object->index != 0; object++) {
            if (object->index == index && object->sub == sub) {
                *found = object;
                return COBOOT_ABORT_NONE;
            }
            if (object->index == index) {
                abort_code = COBOOT_ABORT_NO_SUB_INDEX;
            }
        }
    }
    return abort_code;
}

uint32_t object_read(uint16_t index, uint8_t sub, uint32_t *value, uint8_t *size)
{
    const struct object *object;
    uint32_t abort_code = coboot_program_read(&program, index, sub, value, size);

    if (abort_code == COBOOT_ABORT_NO_OBJECT) {
        abort_code = find(index, sub, &object);
        if (abort_code == COBOOT_ABORT_NONE) {
            *value = *object->value;
            *size = object->size;
        }
    }
    return abort_code;
}

uint32_t object_write(uint16_t index, uint8_t sub, uint32_t value, size_t len)
{
    const struct object *object = NULL;
    uint32_t before;
    uint8_t size;
    const uint32_t abort_code = object_read(index, sub, &before, &size);

    if (abort_code != COBOOT_ABORT_NONE) {
        return abort_code;
    }
    const bool is_object = find(index, sub, &object) == COBOOT_ABORT_NONE;
    if (is_object && object->write == NULL) {
        return COBOOT_ABORT_READ_ONLY;
    }
    if (len != 0 && len != size) {
        return ABORT_LENGTH;
    }
    value &= size == 4 ? UINT32_MAX : (UINT32_C(1) << 8 * size) - 1;
    if (is_object) {
        return object->write(sub, value);
    }
    if (index == COBOOT_PROGRAM_CONTROL) {
        return app_cb_program_ctrl(sub, value);
    }
    return coboot_program_write(&program, index, sub, value, board_now_ms());
}
