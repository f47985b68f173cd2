// Switches to 168 MHz (8 MHz crystal, M 8, N 336, P 2, APB1 /4, APB2 /2, 5 wait states if
// 2000_0100h says so) by polling, then counts SysTick's 16 800 cycles at 2000_0000h and CYCCNT
// over 1 000 000 rounds of a two-cycle loop at 2000_0004h.
.include "program.inc"
vector 15, tick

    mov r6, #RESULTS
    movs r7, #0
    str r7, [r6]
    ldr r0, =ARGUMENT
    ldr r2, [r0]
    ldr r1, =FLASH
    str r2, [r1]
    ldr r1, =RCC
    ldr r0, =0x00010083         // RCC_CR: HSEON
    str r0, [r1]
1:
    ldr r0, [r1]
    lsls r0, r0, #14
    bpl 1b
    ldr r0, =0x00405408         // PLL from the crystal: M 8, N 336, P 2
    str r0, [r1, #4]
    ldr r0, =0x01010083         // RCC_CR: PLLON
    str r0, [r1]
2:
    ldr r0, [r1]
    lsls r0, r0, #6
    bpl 2b
    movw r0, #0x9402            // the PLL; APB1 /4, APB2 /2
    str r0, [r1, #8]
3:
    ldr r0, [r1, #8]
    and r0, r0, #12
    cmp r0, #8
    bne 3b
    ldr r1, =DEMCR
    mov r0, #0x01000000
    str r0, [r1]
    ldr r1, =DWT
    movs r0, #1
    str r0, [r1]
    ldr r2, [r1, #4]
    ldr r3, =1000000
4:
    subs r3, #1
    bne 4b
    ldr r0, [r1, #4]
    subs r0, r0, r2
    str r0, [r6, #4]
    ldr r1, =SYSTICK
    movw r2, #16799
    str r2, [r1, #4]
    str r7, [r1, #8]
    movs r2, #7
    str r2, [r1]
5:
    wfi
    b 5b

handler tick
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    bx lr
    literals
