// Runs at 2000_1000h: SysTick every millisecond with its handler in RAM and the vector table where
// 2000_0100h says (its SysTick vector is written there if that is RAM); erases sector 1 with
// EOPIE; the flash's handler logs the number of ticks until then at 2000_0004h and SR at
// 2000_0008h.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    movs r7, #0
    str r7, [r6]
    str r7, [r6, #4]
    ldr r0, =ARGUMENT
    ldr r0, [r0]
    ldr r1, =VTOR
    str r0, [r1]
    mov r1, #RESULTS
    cmp r0, r1
    bcc 1f
    ldr r1, =tick
    str r1, [r0, #60]
    ldr r1, =done
    str r1, [r0, #80]
1:
    ldr r1, =NVIC_ISER0
    movs r0, #16
    str r0, [r1]
    ldr r1, =SYSTICK
    movw r2, #15999
    str r2, [r1, #4]
    str r7, [r1, #8]
    movs r2, #7
    str r2, [r1]
    ldr r1, =FLASH
    ldr r0, =KEY1
    str r0, [r1, #4]
    ldr r0, =KEY2
    str r0, [r1, #4]
    ldr r0, =0x0101020A         // FLASH_CR: EOPIE, STRT, x32, sector 1, SER
    str r0, [r1, #16]
2:
    wfi
    b 2b

handler tick
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    bx lr

handler done
    ldr r0, [r6]
    str r0, [r6, #4]
    ldr r0, [r1, #12]
    str r0, [r6, #8]
    movs r0, #1
    str r0, [r1, #12]
    bx lr
    literals
