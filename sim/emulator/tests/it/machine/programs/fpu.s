// Uses the FPU after enabling it if 2000_0100h is not 0; line 0's handler clobbers s0 and logs its
// LR at 2000_0000h; s0 comes to 2000_0004h afterwards.
.include "program.inc"
vector 3, hard
vector 16, line0

    mov r6, #RESULTS
    ldr r0, =ARGUMENT
    ldr r0, [r0]
    cmp r0, #0
    beq 1f
    ldr r0, =CPACR
    mov r1, #0x00F00000
    str r1, [r0]
    dsb
    isb
1:
    movs r3, #5
    adds r3, #6
use:
    vmov.f32 s0, #1.5
    vadd.f32 s0, s0, s0
    ldr r5, =NVIC_ISER0
    movs r0, #1
    str r0, [r5]
    ldr r1, =STIR
    movs r0, #0
    str r0, [r1]
    dsb
    isb
    vstr s0, [r6, #4]
2:
    wfi
    b 2b

handler line0
    str lr, [r6]
    mov r0, sp
    str r0, [r6, #8]
    vmov.f32 s0, #8.0
    bx lr

handler hard
    ldr r0, [sp, #24]
    str r0, [r6, #16]
    mrs r0, ipsr
    str r0, [r6, #20]
    str r3, [r6, #24]
    b .
    literals
