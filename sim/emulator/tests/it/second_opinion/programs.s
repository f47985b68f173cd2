// The programs, for a Cortex-M4 with RAM at 2000_0000h. They run in RAM, so that every address in
// a result is the same on all machines. Each starts at a symbol of its own with the stack at
// 2001_0000h, writes words from 2000_0000h on, and ends with a jump to 2000_3000h, where the
// machine has its own code.
//
// r7 is where the next word goes; handlers move it too. r5 and r6 are scratch of the macros.

    .syntax unified
    .thumb

    .macro put value            // a constant becomes the next word
    ldr r6, =\value
    str r6, [r7], #4
    .endm

    .macro log register         // a register becomes the next word
    str \register, [r7], #4
    .endm

    .macro log_special name     // a special register becomes the next word
    mrs r6, \name
    str r6, [r7], #4
    .endm

    .macro log_word address     // the word at an address becomes the next word
    ldr r6, =\address
    ldr r6, [r6]
    str r6, [r7], #4
    .endm

    .macro store address, value
    ldr r6, =\address
    ldr r5, =\value
    str r5, [r6]
    dsb
    isb
    .endm

    .macro store_byte address, value
    ldr r6, =\address
    movs r5, #\value
    strb r5, [r6]
    dsb
    .endm

    .macro vector number, handler
    store 0x20002000 + 4 * \number, \handler
    .endm

    .macro end                  // the last word of every program
    put 0x0E0E0E0E
    ldr r6, =0x20003001
    bx r6
    .ltorg
    .endm

    .macro program name
    .globl \name
    .type \name, %function
    .thumb_func
    \name:
    bl prepare
    .endm

    .macro handler name
    .type \name, %function
    .thumb_func
    \name:
    .endm

    .equ ICSR,  0xE000ED04
    .equ VTOR,  0xE000ED08
    .equ AIRCR, 0xE000ED0C
    .equ SCR,   0xE000ED10
    .equ CCR,   0xE000ED14
    .equ SHPR1, 0xE000ED18
    .equ SHPR2, 0xE000ED1C
    .equ SHPR3, 0xE000ED20
    .equ SHCSR, 0xE000ED24
    .equ CFSR,  0xE000ED28
    .equ HFSR,  0xE000ED2C
    .equ BFAR,  0xE000ED38
    .equ CPACR, 0xE000ED88
    .equ FPCCR, 0xE000EF34
    .equ ISER0, 0xE000E100
    .equ ISPR0, 0xE000E200
    .equ IPR0,  0xE000E400

    .section .text
    // Clears the results, points every vector at a handler that says so, and moves VTOR there.
    handler prepare
    ldr r7, =0x20000000
    movs r0, #0
    mov r1, r7
    add r2, r7, #0x800
1:  str r0, [r1], #4
    cmp r1, r2
    bne 1b
    ldr r1, =0x20002000
    add r2, r1, #0x200
    ldr r0, =unexpected
2:  str r0, [r1], #4
    cmp r1, r2
    bne 2b
    store VTOR, 0x20002000
    bx lr
    .ltorg

    handler unexpected
    mrs r0, ipsr
    movt r0, #0xBAD0
    log r0
    log_word CFSR
    end

    handler log_exception
    log_special ipsr
    bx lr

    // --- order

    program order
    vector 11, log_exception
    vector 14, log_exception
    vector 15, log_exception
    store SHPR2, 0x80000000     // SVCall
    store SHPR3, 0x40C00000     // SysTick before PendSV
    cpsid i
    store ICSR, 0x14000000      // pends both
    put 1
    cpsie i
    isb
    put 2
    svc 0
    put 3
    end

    // --- preemption

    handler first_line
    put 0x10
    store ISPR0, 2
    put 0x12
    bx lr
    .ltorg

    handler second_line
    put 0x11
    bx lr
    .ltorg

    program preemption
    vector 16, first_line
    vector 17, second_line
    store ISER0, 3
    store_byte IPR0, 0x80
    store_byte IPR0 + 1, 0x40
    store ISPR0, 1              // a more urgent line interrupts the handler
    put 1
    store_byte IPR0 + 1, 0x80
    store ISPR0, 1              // the same priority waits
    put 2
    store AIRCR, 0x05FA0600     // group = bit 7
    store_byte IPR0, 0xC0
    store_byte IPR0 + 1, 0x80
    store ISPR0, 1              // the same group waits
    put 3
    cpsid i
    store ISPR0, 3              // and the subpriority says who comes first
    cpsie i
    isb
    put 4
    end

    // --- masks

    handler line
    put 0x10
    bx lr
    .ltorg

    program basepri
    vector 16, line
    store ISER0, 1
    store_byte IPR0, 0x80
    movs r0, #0x80
    msr basepri, r0
    store ISPR0, 1              // masked: the same priority
    put 1
    log_word ISPR0
    movs r0, #0x90
    msr basepri, r0             // lowered: taken
    isb
    put 2
    movs r0, #0x40
    msr basepri, r0
    store ISPR0, 1
    movs r0, #0x80
    msr basepri_max, r0         // would lower: ignored
    isb
    log_special basepri
    movs r0, #0x20
    msr basepri_max, r0         // raises
    isb
    log_special basepri
    movs r0, #0
    msr basepri_max, r0         // zero is ignored
    isb
    log_special basepri
    msr basepri, r0             // zero masks nothing: taken
    isb
    put 3
    end

    program basepri_max
    vector 16, line
    store ISER0, 1
    store_byte IPR0, 0x80
    movs r0, #0xC0
    msr basepri_max, r0         // from 0, which masks nothing, any value raises
    log_special basepri
    movs r0, #0xF0
    msr basepri_max, r0         // would lower: ignored
    log_special basepri
    movs r0, #0x80
    msr basepri_max, r0         // raises, and masks the line
    isb
    log_special basepri
    store ISPR0, 1
    put 1
    movs r0, #0xC0
    msr basepri_max, r0         // does not let it in
    isb
    put 2
    msr basepri, r0             // does
    isb
    put 3
    end

    handler sets_faultmask
    cpsid f
    log_special faultmask
    bx lr
    .ltorg

    program masks
    vector 16, line
    store ISER0, 1
    cpsid i
    store ISPR0, 1
    log_special primask
    cpsie i
    isb
    put 1
    cpsid f
    store ISPR0, 1
    log_special faultmask
    cpsie f
    isb
    put 2
    vector 16, sets_faultmask   // the return from the handler clears it
    store ISPR0, 1
    log_special faultmask
    end

    // --- priorities that change

    handler raises_the_other
    put 0x20
    store ISPR0, 2              // less urgent: waits
    put 0x21
    store_byte IPR0 + 1, 0x40   // more urgent now: interrupts
    isb
    put 0x22
    bx lr
    .ltorg

    program reprioritised
    vector 16, line
    vector 17, second_line
    store ISER0, 3
    store_byte IPR0, 0x40
    store_byte IPR0 + 1, 0x80
    cpsid i
    store ISPR0, 3
    store_byte IPR0 + 1, 0x20   // both are pending
    cpsie i
    isb
    put 1
    store_byte IPR0 + 1, 0x80
    movs r0, #0x80
    msr basepri, r0
    store ISPR0, 2
    put 2
    store_byte IPR0 + 1, 0x60   // above BASEPRI now
    isb
    put 3
    movs r0, #0
    msr basepri, r0
    vector 16, raises_the_other
    store_byte IPR0, 0x80
    store_byte IPR0 + 1, 0xC0
    store ISPR0, 1
    put 4
    end

    // --- where the vectors are

    handler from_the_second_table
    put 0x20
    bx lr
    .ltorg

    program vector_table
    vector 14, log_exception
    store 0x20002400 + 4 * 14, from_the_second_table
    store ICSR, 0x10000000
    store VTOR, 0x20002400
    log_word VTOR
    store ICSR, 0x10000000
    cpsid i
    store ICSR, 0x10000000
    store VTOR, 0x20002000      // pending, but the vector is read when it is taken
    cpsie i
    isb
    put 1
    end

    // --- stack frames

    handler log_frame
    log lr
    mov r4, sp
    log r4
    mov r8, #8
1:  ldr r6, [r4], #4
    log r6
    subs r8, #1
    bne 1b
    bx lr
    .ltorg

    program frame
    vector 11, log_frame
    ldr r0, =0xA0A0A0A0
    ldr r1, =0xA1A1A1A1
    ldr r2, =0xA2A2A2A2
    ldr r3, =0xA3A3A3A3
    ldr r12, =0xACACACAC
    ldr lr, =0xAEAEAEAE
    cmp r0, r0                  // Z and C
    svc 0
after_first:
    sub sp, #4                  // the frame is aligned to 8 bytes
    cmp r0, r0
    svc 0
after_second:
    mov r6, sp
    log r6
    end

    handler log_float_frame
    log lr
    ldr r4, =FPCCR
    ldr r6, [r4]
    and r6, #1                  // LSPACT: the room is there, the registers are not saved yet
    log r6
    log_special control
    vmov.f32 s0, #2.0           // saves them first
    ldr r6, [r4]
    and r6, #1
    log r6
    mov r6, sp
    log r6
    ldr r6, [sp, #32]           // s0
    log r6
    bx lr
    .ltorg

    program float_frame
    vector 11, log_float_frame
    store CPACR, 0x00F00000
    log_special control
    vmov.f32 s0, #1.0
    log_special control         // FPCA
    svc 0
    vmov r6, s0
    log r6
    log_special control
    end

    program fpscr
    vector 11, log_lr
    store CPACR, 0x00F00000
    vmov.f32 s0, #1.0
    vmov.f32 s1, #3.0
    ldr r0, =0xA3C00081         // N, C; DN, FZ, towards zero; IDC, IOC
    vmsr fpscr, r0
    svc 0
    vmrs r6, fpscr
    log r6
    vdiv.f32 s2, s0, s1         // 3EAAAAAAh towards zero, 3EAAAAABh to nearest
    vmov r6, s2
    log r6
    vmrs r6, fpscr              // and IXC
    log r6
    end

    handler log_lr
    log lr
    bx lr

    .macro log_rounding         // what a new context takes from FPDSCR (FPSCR[26:22])
    vmrs r6, fpscr
    and r6, #0x07C00000
    log r6
    .endm

    .macro log_s0
    vmov r6, s0
    log r6
    .endm

    .macro round mode           // FPSCR.RMode
    ldr r6, =\mode << 22
    vmsr fpscr, r6
    .endm

    handler outer_float
    log lr
    log_rounding
    vmov.f32 s0, #2.0
    round 2
    store ISPR0, 1
    log_s0
    log_rounding
    bx lr
    .ltorg

    handler inner_float
    log lr
    log_rounding
    vmov.f32 s0, #3.0
    round 1
    bx lr
    .ltorg

    program nested_float
    vector 11, outer_float
    vector 16, inner_float
    store CPACR, 0x00F00000
    store SHPR2, 0x80000000
    store ISER0, 1
    vmov.f32 s0, #1.0
    round 3
    svc 0
    log_s0
    log_rounding
    end

    program process_stack
    vector 11, log_exception_return
    ldr r0, =0x20008000
    msr psp, r0
    movs r0, #2
    msr control, r0
    isb
    log_special control
    mov r6, sp
    log r6
    svc 0
    movs r0, #3
    msr control, r0             // and without privilege
    isb
    cpsid i                     // ignored
    movs r0, #0
    msr control, r0             // ignored
    isb
    svc 0
    end

    handler log_exception_return
    log lr
    log_special psp
    log_special msp
    log_special control
    log_special primask
    movs r6, #0                 // privileged again
    msr control, r6
    bx lr
    .ltorg

    // --- faults: r8 is where to go on, r9 the instruction at fault

    handler log_bus_fault
    log_word BFAR
    b log_fault
    .ltorg

    handler log_fault
    ldr r6, [sp, #24]
    sub r6, r6, r9
    log r6

    .macro log_reasons          // the exception and its reasons, which are cleared
    log_special ipsr
    ldr r4, =CFSR
    ldr r6, [r4]
    log r6
    str r6, [r4]
    ldr r4, =HFSR
    ldr r6, [r4]
    log r6
    str r6, [r4]
    .endm

    handler log_status
    log_reasons
    str r8, [sp, #24]
    bx lr
    .ltorg

    .macro fails instruction:vararg
    adr.w r9, 3f
    adr.w r8, 4f
    .balign 4
3:  \instruction
    .balign 4
4:
    .endm

    program usage_fault
    vector 6, log_fault
    store SHCSR, 0x00040000
    fails udf #0
    end

    program traps
    vector 6, log_fault
    store SHCSR, 0x00040000
    store CCR, 0x00000218       // STKALIGN, DIV_0_TRP, UNALIGN_TRP
    movs r0, #1
    movs r1, #0
    fails udiv r2, r0, r1
    ldr r0, =0x20000402
    fails ldr r1, [r0]
    store CCR, 0x00000200
    movs r0, #1
    udiv r2, r0, r1
    put 1
    end

    // In an IT block: the IT state goes onto the stack, and does not come back.
    handler log_fault_in_it
    ldr r6, [sp, #28]
    ldr r5, =0x0600FC00
    and r4, r6, r5
    log r4
    bic r6, r5
    str r6, [sp, #28]
    b log_fault
    .ltorg

    .macro points               // 3 is the instruction at fault, 4 where to go on
    adr.w r9, 3f
    adr.w r8, 4f
    cmp r0, r0                  // EQ
    b 2f
    .balign 4
2:
    .endm

    program traps_in_it
    vector 6, log_fault_in_it
    store SHCSR, 0x00040000
    store CCR, 0x00000218
    movs r0, #6
    movs r1, #0
    points
    itet eq
    moveq r2, #5
    udivne r2, r0, r1           // skipped
3:  udiveq r2, r0, r1
4:  log r2                      // as before
    movs r1, #4
    points
    itt eq
    moveq r1, #0                // brings the fault about
3:  sdiveq r2, r0, r1
4:  movs r1, #0
    cmp r0, r0
    itt eq
    moveq r1, #2                // prevents it
    udiveq r2, r0, r1
    log r2
    ldr r3, =0x20000402
    cmp r0, r0
    ite ne
    ldrne r2, [r3]              // skipped
    moveq r2, #7
    log r2
    points
    nop
    itt eq
3:  streq r2, [r3]
    moveq r2, #8                // not reached
4:  log r2
    log_word 0x20000400
    put 1
    end

    handler count_fault
    ldr r4, =CFSR
    ldr r6, [r4]
    str r6, [r4]
    orr r10, r6
    str r8, [sp, #24]
    bx lr
    .ltorg

    .macro faults instruction:vararg    // CFSR, or 0 without a fault
    mov r10, #0
    fails \instruction
    log r10
    .endm

    program alignment
    vector 6, count_fault
    store SHCSR, 0x00040000
    store CPACR, 0x00F00000
    store 0x20000400, 0x44332211
    store 0x20000404, 0x88776655
    ldr r0, =0x20000401
    ldr r1, [r0]
    log r1
    ldrsh.w r1, [r0]
    log r1
    ldr r1, =0xA5A6A7A8
    str r1, [r0, #1]
    strh r1, [r0, #4]
    log_word 0x20000400
    log_word 0x20000404
    add r0, #1
    faults ldrex r1, [r0]
    faults strex r2, r1, [r0]
    faults ldrexh r1, [r0]      // 0x20000402: aligned
    faults ldm r0, {r1, r2}
    faults stm r0, {r1, r2}
    faults ldrd r1, r2, [r0]
    faults strd r1, r2, [r0]
    faults vldr s0, [r0]
    faults vstr s0, [r0]
    store CCR, 0x00000208       // UNALIGN_TRP
    faults ldr r1, [r0]
    faults str r1, [r0]
    faults ldrh r1, [r0]
    faults ldrh r1, [r0, #1]
    faults strh r1, [r0, #-1]
    faults ldrb r1, [r0, #1]
    faults ldr r1, [r0, #2]
    movs r3, #1
    faults ldr r1, [r0, r3, lsl #1]
    faults ldr r1, [r0, r3]
    faults strh r1, [r0, r3]
    faults ldm r0, {r1, r2}
    faults strd r1, r2, [r0]
    faults vldr s0, [r0]
    store CCR, 0x00000200
    faults ldr r1, [r0]
    end

    program bus_fault
    vector 5, log_bus_fault
    store SHCSR, 0x00020000
    ldr r0, =0xA0000000
    fails ldr r1, [r0]
    end

    program escalation
    vector 3, log_fault
    vector 6, log_exception
    vector 11, log_exception
    fails udf #0                // UsageFault is not enabled
    vector 3, log_status        // where SVC goes on is not compared
    store SHPR2, 0x80000000
    movs r0, #0x40
    msr basepri, r0
    isb
    fails svc 0                 // SVCall is masked
    log_special basepri
    end

    // --- no stack to write the frame to

    // Makes a frame for the return to r8.
    handler log_and_mend_stack
    log_reasons
    ldr r4, =SHCSR
    ldr r6, [r4]
    and r6, #0xF000             // what is pending
    log r6
    ldr r4, =0x20008000
    str r8, [r4, #24]
    mov r6, #0x01000000
    str r6, [r4, #28]
    msr psp, r4
    bx lr
    .ltorg

    .macro without_stack instruction:vararg
    ldr r0, =0xA0000100
    msr psp, r0
    isb
    adr.w r8, 4f
    \instruction
    .balign 4
4:
    .endm

    program stacking
    vector 3, log_and_mend_stack
    vector 5, log_and_mend_stack
    vector 6, log_and_mend_stack
    vector 11, log_and_mend_stack
    vector 16, log_and_mend_stack
    store ISER0, 1
    store_byte IPR0, 0x80
    store SHPR2, 0x80000000
    movs r0, #2
    msr control, r0
    isb
    store SHCSR, 0x00060000     // BusFault, UsageFault
    store SHPR1, 0x00804000
    without_stack svc 0         // BusFault first
    put 1
    without_stack store ISPR0, 1
    put 2
    without_stack udf #0
    put 3
    store SHPR1, 0x0000C000
    without_stack svc 0         // BusFault second
    put 4
    store SHPR1, 0x00008000
    store SHPR2, 0x40000000
    movs r0, #0x60
    msr basepri, r0
    without_stack svc 0         // BusFault is masked: HardFault first
    put 5
    movs r0, #0
    msr basepri, r0
    store SHCSR, 0
    without_stack svc 0         // BusFault is not enabled: HardFault first
    put 6
    without_stack udf #0        // neither is UsageFault: one HardFault
    put 7
    end

    // --- the rest

    program bit_band
    store 0x22000000 + 0x400 * 32 + 3 * 4, 1
    log_word 0x20000400
    log_word 0x22000000 + 0x400 * 32 + 3 * 4
    log_word 0x22000000 + 0x400 * 32 + 2 * 4
    store 0x22000000 + 0x400 * 32 + 31 * 4, 0xFF
    log_word 0x20000400
    store 0x22000000 + 0x400 * 32 + 3 * 4, 0xFE
    log_word 0x20000400
    end

    program systick
    store 0xE000E014, 9999
    store 0xE000E018, 0x1234    // any value clears the counter
    log_word 0xE000E018
    store 0xE000E010, 5
    ldr r4, =0xE000E010
1:  ldr r0, [r4]
    tst r0, #0x10000
    beq 1b
    ldr r1, [r4]                // the read has cleared COUNTFLAG
    log r0
    log r1
    log_word 0xE000E014
    end

    program wait
    vector 14, log_exception
    cpsid i
    store ICSR, 0x10000000
    wfi                         // a pending exception wakes, even masked by PRIMASK
    put 1
    cpsie i
    isb
    put 2
    end

    handler third_time_wakes
    add r4, #1
    cmp r4, #3
    bne 1f
    store SCR, 0
1:  bx lr
    .ltorg

    program sleep_on_exit
    vector 15, third_time_wakes
    store 0xE000E014, 9999
    store 0xE000E018, 0
    movs r4, #0
    store SCR, 2
    store 0xE000E010, 7
    wfi                         // goes on after the third interrupt
    log r4
    log_word SCR
    store 0xE000E010, 0
    end

    program priority_bits
    store IPR0, 0xFFFFFFFF
    log_word IPR0
    end

    // The end on a machine with semihosting: the first 64 words go to standard output.
    handler semihosted_end
    movs r0, #1                 // SYS_OPEN ":tt", mode "wb"
    adr.w r1, open_block
    bkpt 0xAB
    ldr r1, =0x20003100
    str r0, [r1]
    ldr r0, =0x20000000
    str r0, [r1, #4]
    mov r0, #256
    str r0, [r1, #8]
    movs r0, #5                 // SYS_WRITE
    bkpt 0xAB
    movs r0, #0x18              // SYS_EXIT, ADP_Stopped_ApplicationExit
    ldr r1, =0x20026
    bkpt 0xAB
    b .
    .ltorg
    .balign 4
open_block:
    .word terminal, 5, 3
terminal:
    .asciz ":tt"
