#include "sdo.h"

#include "objects.h"

/* Command specifiers of the client, and the specifier of an abort. */
enum { DOWNLOAD = 1, UPLOAD = 2, ABORT = 4, BLOCK_UPLOAD = 5, BLOCK_DOWNLOAD = 6 };

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

static uint32_t download(uint16_t index, uint8_t sub, const uint8_t *request)
{
    const bool expedited = (request[0] & 2) != 0, size_indicated = (request[0] & 1) != 0;
    const unsigned unused = request[0] >> 2 & 3;
    return object_write(index, sub, word_at(&request[4]), !expedited ? SIZE_MAX : size_indicated ? 4 - unused : 0);
}

static bool names_object(uint8_t command)
{
    switch (command >> 5) {
    case DOWNLOAD:
    case UPLOAD:
        return true;
    case BLOCK_UPLOAD:
        return (command & 3) == 0;
    case BLOCK_DOWNLOAD:
        return (command & 1) == 0;
    default:
        return false;
    }
}

bool sdo_answer(const uint8_t request[8], uint8_t answer[8])
{
    const uint16_t index = (uint16_t)(request[1] | request[2] << 8);
    const uint8_t sub = request[3];
    uint32_t abort_code = ABORT_COMMAND, value = 0;
    uint8_t size = 0;

    /* Of the requests that are aborted here, only the initiate of a block transfer names an object (CiA 301
     * section 7.2.4.3): a subcommand of 0. */
    for (unsigned i = 1; i <= 3; i++) {
        answer[i] = names_object(request[0]) ? request[i] : 0;
    }
    switch (request[0] >> 5) {
    case DOWNLOAD:
        abort_code = download(index, sub, request);
        answer[0] = 0x60;
        break;
    case UPLOAD:
        abort_code = object_read(index, sub, &value, &size);
        answer[0] = (uint8_t)(0x43 | (4 - size) << 2);
        break;
    case ABORT:
        return false;
    default:
        break;
    }
    if (abort_code != COBOOT_ABORT_NONE) {
        answer[0] = 0x80;
        value = abort_code;
    }
    put_word(&answer[4], value);
    return true;
}
