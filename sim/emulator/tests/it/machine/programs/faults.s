// Causes the fault that 2000_0100h chooses, with the faults of 2000_0104h (SHCSR) enabled. The
// handler logs IPSR, CFSR, HFSR, BFAR, the stacked PC.
.include "program.inc"
vector 3, fault
vector 4, fault
vector 5, fault
vector 6, fault

    mov r6, #RESULTS
    ldr r0, =ARGUMENT
    ldr r1, [r0, #4]
    ldr r2, =SHCSR
    str r1, [r2]
    ldr r7, [r0]
    cmp r7, #0
    beq bad_load
    cmp r7, #1
    beq undefined
    cmp r7, #2
    beq no_thumb
    cmp r7, #3
    beq not_aligned
    cmp r7, #4
    beq breakpoint
    cmp r7, #5
    beq bad_store
    cmp r7, #6
    beq bad_fetch
    cmp r7, #7
    beq ccm_fetch
    b .
bad_load:
    ldr r0, =0x60000010
    ldr r0, [r0]
undefined:
    udf #0
no_thumb:
    ldr r0, =0x08000200         // without the Thumb bit
    bx r0
not_aligned:
    ldr r0, =0x20000002
    ldrd r0, r1, [r0]
breakpoint:
    bkpt #0
bad_store:
    ldr r0, =0x60000010
    str r0, [r0]
    nop
bad_fetch:
    ldr r0, =0x60000011
    bx r0
ccm_fetch:
    ldr r0, =0x10000001         // the CCM holds no code
    bx r0
    literals

handler fault
    mrs r0, ipsr
    str r0, [r6]
    ldr r1, =CFSR
    ldr r0, [r1]
    str r0, [r6, #4]
    ldr r0, [r1, #4]
    str r0, [r6, #8]
    ldr r0, [r1, #16]
    str r0, [r6, #12]
    ldr r0, [sp, #24]
    str r0, [r6, #16]
    ldr r0, =0x20000108
    ldr r0, [r0]
    cmp r0, #0
    beq 1f
    udf #0
1:
    b .
    literals
