/* What a program for the chip takes from the header and from the library. */
#include "coboot.h"
#include "program.h"

COBOOT_LABEL(1, 2, 3);

#ifdef __cplusplus
extern "C" {
#endif
int call(void);
void leave(void);
#ifdef __cplusplus
}
#endif

int call(void)
{
    const struct coboot_callgate *gate = coboot_callgate();
    struct coboot_handoff handoff;
    struct coboot_node_args node;
    struct coboot_program_args program;
    uint32_t crc;
    return coboot_read_handoff(&handoff) && coboot_nameplate(&handoff) == NULL && coboot_crc32(gate, 0, 4, &crc) == 0 && coboot_read_node(gate, &node) == 0
        && coboot_store_node(gate, 1, 125000) == 0 && coboot_program_info(gate, 1, &program) == 0
        && coboot_confirm(gate, 1) == 0 && coboot_invalidate(gate, 1) == 0 && coboot_unconfirm(gate, 1) == 0;
}

void leave(void)
{
    coboot_reset(COBOOT_REQUEST_STORE_NODE, coboot_stored_node(1, 125000));
}
