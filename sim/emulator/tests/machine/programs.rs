//! Thumb programs as machine code, with the listing of GNU as beside it, so that the tests need no
//! assembler.

/// A program: its code, where that lies, and the exception handlers by exception number.
pub struct Program {
    /// Address of the first instruction, which is the entry point of a program in flash.
    pub base: u32,
    /// (exception number, vector).
    pub vectors: &'static [(usize, u32)],
    /// Machine code, half-word by half-word.
    pub code: &'static [u16],
}

/// Stores 42 and its stack pointer, then sleeps.
pub const STORES_AND_SLEEPS: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0x202A,              // 200  movs r0, #42
        0xF04F, 0x5100,      // 202  mov.w r1, #536870912
        0x6008,              // 206  str r0, [r1, #0]
        0x466A,              // 208  mov r2, sp
        0x604A,              // 20A  str r2, [r1, #4]
        0xBF30,              // 20C  wfi
        0xE7FD,              // 20E  b.n 800020c
    ],
};

/// SysTick every 16 000 cycles; its handler counts at 2000_0000h. The loop counts its wake-ups at
/// 2000_0004h.
pub const SYSTICK: Program = Program {
    base: 0x0800_0200,
    vectors: &[(15, 0x0800_0223)],
    code: &[
        0xF04F, 0x5400,      // 200  mov.w r4, #536870912
        0x2000,              // 204  movs r0, #0
        0x6020,              // 206  str r0, [r4, #0]
        0x6060,              // 208  str r0, [r4, #4]
        0x4909,              // 20A  ldr r1, [pc, #36]
        0xF643, 0x627F,      // 20C  movw r2, #15999
        0x604A,              // 210  str r2, [r1, #4]
        0x6088,              // 212  str r0, [r1, #8]
        0x2207,              // 214  movs r2, #7
        0x600A,              // 216  str r2, [r1, #0]
        0xBF30,              // 218  wfi
        0x6860,              // 21A  ldr r0, [r4, #4]
        0x3001,              // 21C  adds r0, #1
        0x6060,              // 21E  str r0, [r4, #4]
        0xE7FA,              // 220  b.n 8000218
        0xF04F, 0x5100,      // 222 tick:  mov.w r1, #536870912
        0x6808,              // 226  ldr r0, [r1, #0]
        0x3001,              // 228  adds r0, #1
        0x6008,              // 22A  str r0, [r1, #0]
        0x4770,              // 22C  bx lr
        0x0000,              // 22E  .short 0x0000
        0xE010, 0xE000,      // 230  .word 0xe000e010
    ],
};

/// Line 0 pends line 1 from its handler. What happens is logged from 2000_0000h on: 1 line 0
/// starts, its LR; 2 line 1, its LR and its SP; 3 line 0 ends; 4 back in the thread. The priority
/// of line 1 is taken from 2000_0100h.
pub const NESTING: Program = Program {
    base: 0x0800_0200,
    vectors: &[(16, 0x0800_022F), (17, 0x0800_024F)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4D16,              // 204  ldr r5, [pc, #88]
        0x2003,              // 206  movs r0, #3
        0x6028,              // 208  str r0, [r5, #0]
        0x4916,              // 20A  ldr r1, [pc, #88]
        0x4A16,              // 20C  ldr r2, [pc, #88]
        0x6810,              // 20E  ldr r0, [r2, #0]
        0x0200,              // 210  lsls r0, r0, #8
        0x3080,              // 212  adds r0, #128
        0x8008,              // 214  strh r0, [r1, #0]
        0x4915,              // 216  ldr r1, [pc, #84]
        0x2000,              // 218  movs r0, #0
        0x6008,              // 21A  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 21C  dsb sy
        0xF3BF, 0x8F6F,      // 220  isb sy
        0x2004,              // 224  movs r0, #4
        0x6030,              // 226  str r0, [r6, #0]
        0x3604,              // 228  adds r6, #4
        0xBF30,              // 22A  wfi
        0xE7FD,              // 22C  b.n 800022a
        0x2001,              // 22E line0:  movs r0, #1
        0x6030,              // 230  str r0, [r6, #0]
        0xF8C6, 0xE004,      // 232  str.w lr, [r6, #4]
        0x3608,              // 236  adds r6, #8
        0x2002,              // 238  movs r0, #2
        0x490D,              // 23A  ldr r1, [pc, #52]
        0x6008,              // 23C  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 23E  dsb sy
        0xF3BF, 0x8F6F,      // 242  isb sy
        0x2003,              // 246  movs r0, #3
        0x6030,              // 248  str r0, [r6, #0]
        0x3604,              // 24A  adds r6, #4
        0x4770,              // 24C  bx lr
        0x2002,              // 24E line1:  movs r0, #2
        0x6030,              // 250  str r0, [r6, #0]
        0xF8C6, 0xE004,      // 252  str.w lr, [r6, #4]
        0x4668,              // 256  mov r0, sp
        0x60B0,              // 258  str r0, [r6, #8]
        0x360C,              // 25A  adds r6, #12
        0x4770,              // 25C  bx lr
        0x0000,              // 25E  .short 0x0000
        0xE100, 0xE000,      // 260  .word 0xe000e100
        0xE400, 0xE000,      // 264  .word 0xe000e400
        0x0100, 0x2000,      // 268  .word 0x20000100
        0xEF00, 0xE000,      // 26C  .word 0xe000ef00
        0xE200, 0xE000,      // 270  .word 0xe000e200
    ],
};

/// Line 0 at priority 80h is pended under BASEPRI 80h and under PRIMASK; the log at 2000_0000h
/// shows when its handler (9) comes.
pub const MASKS: Program = Program {
    base: 0x0800_0200,
    vectors: &[(16, 0x0800_025B)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4D17,              // 204  ldr r5, [pc, #92]
        0x2001,              // 206  movs r0, #1
        0x6028,              // 208  str r0, [r5, #0]
        0x4917,              // 20A  ldr r1, [pc, #92]
        0x2080,              // 20C  movs r0, #128
        0x7008,              // 20E  strb r0, [r1, #0]
        0x2080,              // 210  movs r0, #128
        0xF380, 0x8811,      // 212  msr BASEPRI, r0
        0x2201,              // 216  movs r2, #1
        0x4914,              // 218  ldr r1, [pc, #80]
        0x600A,              // 21A  str r2, [r1, #0]
        0xF3BF, 0x8F4F,      // 21C  dsb sy
        0xF3BF, 0x8F6F,      // 220  isb sy
        0x2001,              // 224  movs r0, #1
        0x6030,              // 226  str r0, [r6, #0]
        0x3604,              // 228  adds r6, #4
        0x2000,              // 22A  movs r0, #0
        0xF380, 0x8811,      // 22C  msr BASEPRI, r0
        0xF3BF, 0x8F6F,      // 230  isb sy
        0x2002,              // 234  movs r0, #2
        0x6030,              // 236  str r0, [r6, #0]
        0x3604,              // 238  adds r6, #4
        0xB672,              // 23A  cpsid i
        0x600A,              // 23C  str r2, [r1, #0]
        0xF3BF, 0x8F4F,      // 23E  dsb sy
        0xBF30,              // 242  wfi
        0x2003,              // 244  movs r0, #3
        0x6030,              // 246  str r0, [r6, #0]
        0x3604,              // 248  adds r6, #4
        0xB662,              // 24A  cpsie i
        0xF3BF, 0x8F6F,      // 24C  isb sy
        0x2004,              // 250  movs r0, #4
        0x6030,              // 252  str r0, [r6, #0]
        0x3604,              // 254  adds r6, #4
        0xBF30,              // 256  wfi
        0xE7FD,              // 258  b.n 8000256
        0x2009,              // 25A line0:  movs r0, #9
        0x6030,              // 25C  str r0, [r6, #0]
        0x3604,              // 25E  adds r6, #4
        0x4770,              // 260  bx lr
        0x0000,              // 262  .short 0x0000
        0xE100, 0xE000,      // 264  .word 0xe000e100
        0xE400, 0xE000,      // 268  .word 0xe000e400
        0xE200, 0xE000,      // 26C  .word 0xe000e200
    ],
};

/// The thread goes to the process stack and calls SVC; logged: LR and MSP in the handler, the
/// stacked PC, CONTROL and SP back in the thread.
pub const PROCESS_STACK: Program = Program {
    base: 0x0800_0200,
    vectors: &[(11, 0x0800_0225)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4811,              // 204  ldr r0, [pc, #68]
        0xF380, 0x8809,      // 206  msr PSP, r0
        0x2002,              // 20A  movs r0, #2
        0xF380, 0x8814,      // 20C  msr CONTROL, r0
        0xF3BF, 0x8F6F,      // 210  isb sy
        0xDF07,              // 214  svc 7
        0xF3EF, 0x8014,      // 216 after:  mrs r0, CONTROL
        0x6030,              // 21A  str r0, [r6, #0]
        0x4668,              // 21C  mov r0, sp
        0x6070,              // 21E  str r0, [r6, #4]
        0xBF30,              // 220  wfi
        0xE7FD,              // 222  b.n 8000220
        0xF8C6, 0xE000,      // 224 call:  str.w lr, [r6]
        0x4668,              // 228  mov r0, sp
        0x6070,              // 22A  str r0, [r6, #4]
        0xF3EF, 0x8009,      // 22C  mrs r0, PSP
        0x60B0,              // 230  str r0, [r6, #8]
        0x6981,              // 232  ldr r1, [r0, #24]
        0x60F1,              // 234  str r1, [r6, #12]
        0x69C1,              // 236  ldr r1, [r0, #28]
        0x6131,              // 238  str r1, [r6, #16]
        0xF3EF, 0x8114,      // 23A  mrs r1, CONTROL
        0x6171,              // 23E  str r1, [r6, #20]
        0xF3EF, 0x8105,      // 240  mrs r1, IPSR
        0x61B1,              // 244  str r1, [r6, #24]
        0x361C,              // 246  adds r6, #28
        0x4770,              // 248  bx lr
        0x0000,              // 24A  .short 0x0000
        0x8004, 0x2000,      // 24C  .word 0x20008004
    ],
};

/// Uses the FPU after enabling it if 2000_0100h is not 0; line 0's handler clobbers s0 and logs its
/// LR at 2000_0000h; s0 comes to 2000_0004h afterwards.
pub const FPU: Program = Program {
    base: 0x0800_0200,
    vectors: &[(3, 0x0800_0253), (16, 0x0800_0245)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4816,              // 204  ldr r0, [pc, #88]
        0x6800,              // 206  ldr r0, [r0, #0]
        0x2800,              // 208  cmp r0, #0
        0xD007,              // 20A  beq.n 800021c
        0x4815,              // 20C  ldr r0, [pc, #84]
        0xF44F, 0x0170,      // 20E  mov.w r1, #15728640
        0x6001,              // 212  str r1, [r0, #0]
        0xF3BF, 0x8F4F,      // 214  dsb sy
        0xF3BF, 0x8F6F,      // 218  isb sy
        0x2305,              // 21C  movs r3, #5
        0x3306,              // 21E  adds r3, #6
        0xEEB7, 0x0A08,      // 220 use:  vmov.f32 s0, #120
        0xEE30, 0x0A00,      // 224  vadd.f32 s0, s0, s0
        0x4D0F,              // 228  ldr r5, [pc, #60]
        0x2001,              // 22A  movs r0, #1
        0x6028,              // 22C  str r0, [r5, #0]
        0x490F,              // 22E  ldr r1, [pc, #60]
        0x2000,              // 230  movs r0, #0
        0x6008,              // 232  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 234  dsb sy
        0xF3BF, 0x8F6F,      // 238  isb sy
        0xED86, 0x0A01,      // 23C  vstr s0, [r6, #4]
        0xBF30,              // 240  wfi
        0xE7FD,              // 242  b.n 8000240
        0xF8C6, 0xE000,      // 244 line0:  str.w lr, [r6]
        0x4668,              // 248  mov r0, sp
        0x60B0,              // 24A  str r0, [r6, #8]
        0xEEB2, 0x0A00,      // 24C  vmov.f32 s0, #32
        0x4770,              // 250  bx lr
        0x9806,              // 252 hard:  ldr r0, [sp, #24]
        0x6130,              // 254  str r0, [r6, #16]
        0xF3EF, 0x8005,      // 256  mrs r0, IPSR
        0x6170,              // 25A  str r0, [r6, #20]
        0x61B3,              // 25C  str r3, [r6, #24]
        0xE7FE,              // 25E  b.n 800025e
        0x0100, 0x2000,      // 260  .word 0x20000100
        0xED88, 0xE000,      // 264  .word 0xe000ed88
        0xE100, 0xE000,      // 268  .word 0xe000e100
        0xEF00, 0xE000,      // 26C  .word 0xe000ef00
    ],
};

/// Causes the fault that 2000_0100h chooses, with the faults of 2000_0104h (SHCSR) enabled. The
/// handler logs IPSR, CFSR, HFSR, BFAR, the stacked PC.
pub const FAULTS: Program = Program {
    base: 0x0800_0200,
    vectors: &[(3, 0x0800_026D), (4, 0x0800_026D), (5, 0x0800_026D), (6, 0x0800_026D)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4812,              // 204  ldr r0, [pc, #72]
        0x6841,              // 206  ldr r1, [r0, #4]
        0x4A12,              // 208  ldr r2, [pc, #72]
        0x6011,              // 20A  str r1, [r2, #0]
        0x6807,              // 20C  ldr r7, [r0, #0]
        0x2F00,              // 20E  cmp r7, #0
        0xD00E,              // 210  beq.n 8000230
        0x2F01,              // 212  cmp r7, #1
        0xD00E,              // 214  beq.n 8000234
        0x2F02,              // 216  cmp r7, #2
        0xD00D,              // 218  beq.n 8000236
        0x2F03,              // 21A  cmp r7, #3
        0xD00D,              // 21C  beq.n 800023a
        0x2F04,              // 21E  cmp r7, #4
        0xD00E,              // 220  beq.n 8000240
        0x2F05,              // 222  cmp r7, #5
        0xD00D,              // 224  beq.n 8000242
        0x2F06,              // 226  cmp r7, #6
        0xD00E,              // 228  beq.n 8000248
        0x2F07,              // 22A  cmp r7, #7
        0xD00E,              // 22C  beq.n 800024c
        0xE7FE,              // 22E  b.n 800022e
        0x4809,              // 230 bad_load:  ldr r0, [pc, #36]
        0x6800,              // 232  ldr r0, [r0, #0]
        0xDE00,              // 234 undefined:  udf #0
        0x4809,              // 236 no_thumb:  ldr r0, [pc, #36]
        0x4700,              // 238  bx r0
        0x4809,              // 23A not_aligned:  ldr r0, [pc, #36]
        0xE9D0, 0x0100,      // 23C  ldrd r0, r1, [r0]
        0xBE00,              // 240 breakpoint:  bkpt 0x0000
        0x4805,              // 242 bad_store:  ldr r0, [pc, #20]
        0x6000,              // 244  str r0, [r0, #0]
        0xBF00,              // 246  nop
        0x4806,              // 248 bad_fetch:  ldr r0, [pc, #24]
        0x4700,              // 24A  bx r0
        0x4806,              // 24C ccm_fetch:  ldr r0, [pc, #24]
        0x4700,              // 24E  bx r0
        0x0100, 0x2000,      // 250  .word 0x20000100
        0xED24, 0xE000,      // 254  .word 0xe000ed24
        0x0010, 0x6000,      // 258  .word 0x60000010
        0x0200, 0x0800,      // 25C  .word 0x08000200
        0x0002, 0x2000,      // 260  .word 0x20000002
        0x0011, 0x6000,      // 264  .word 0x60000011
        0x0001, 0x1000,      // 268  .word 0x10000001
        0xF3EF, 0x8005,      // 26C fault:  mrs r0, IPSR
        0x6030,              // 270  str r0, [r6, #0]
        0x4907,              // 272  ldr r1, [pc, #28]
        0x6808,              // 274  ldr r0, [r1, #0]
        0x6070,              // 276  str r0, [r6, #4]
        0x6848,              // 278  ldr r0, [r1, #4]
        0x60B0,              // 27A  str r0, [r6, #8]
        0x6908,              // 27C  ldr r0, [r1, #16]
        0x60F0,              // 27E  str r0, [r6, #12]
        0x9806,              // 280  ldr r0, [sp, #24]
        0x6130,              // 282  str r0, [r6, #16]
        0x4803,              // 284  ldr r0, [pc, #12]
        0x6800,              // 286  ldr r0, [r0, #0]
        0x2800,              // 288  cmp r0, #0
        0xD000,              // 28A  beq.n 800028e
        0xDE00,              // 28C  udf #0
        0xE7FE,              // 28E  b.n 800028e
        0xED28, 0xE000,      // 290  .word 0xe000ed28
        0x0108, 0x2000,      // 294  .word 0x20000108
    ],
};

/// Logs RCC_CSR at 2000_0010h, counts its starts at 2000_0000h, and asks for a system reset the
/// first time.
pub const RESET: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4909,              // 204  ldr r1, [pc, #36]
        0x6808,              // 206  ldr r0, [r1, #0]
        0x6130,              // 208  str r0, [r6, #16]
        0xF04F, 0x7080,      // 20A  mov.w r0, #16777216
        0x6008,              // 20E  str r0, [r1, #0]
        0x6830,              // 210  ldr r0, [r6, #0]
        0x3001,              // 212  adds r0, #1
        0x6030,              // 214  str r0, [r6, #0]
        0x2801,              // 216  cmp r0, #1
        0xD105,              // 218  bne.n 8000226
        0x4905,              // 21A  ldr r1, [pc, #20]
        0x4805,              // 21C  ldr r0, [pc, #20]
        0x6008,              // 21E  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 220  dsb sy
        0xE7FE,              // 224  b.n 8000224
        0xBF30,              // 226  wfi
        0xE7FD,              // 228  b.n 8000226
        0x0000,              // 22A  .short 0x0000
        0x3874, 0x4002,      // 22C  .word 0x40023874
        0xED0C, 0xE000,      // 230  .word 0xe000ed0c
        0x0004, 0x05FA,      // 234  .word 0x05fa0004
    ],
};

/// Starts the IWDG with the reload value 0 at /32: 1 ms. Reloads it as often as 2000_0100h says,
/// every 800 µs or so.
pub const WATCHDOG: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x490C,              // 204  ldr r1, [pc, #48]
        0xF245, 0x5055,      // 206  movw r0, #21845
        0x6008,              // 20A  str r0, [r1, #0]
        0x2003,              // 20C  movs r0, #3
        0x6048,              // 20E  str r0, [r1, #4]
        0x2000,              // 210  movs r0, #0
        0x6088,              // 212  str r0, [r1, #8]
        0xF64C, 0x40CC,      // 214  movw r0, #52428
        0x6008,              // 218  str r0, [r1, #0]
        0x4A08,              // 21A  ldr r2, [pc, #32]
        0x6812,              // 21C  ldr r2, [r2, #0]
        0xF64A, 0x20AA,      // 21E  movw r0, #43690
        0x2A00,              // 222  cmp r2, #0
        0xD006,              // 224  beq.n 8000234
        0xF44F, 0x53C8,      // 226  mov.w r3, #6400
        0x3B01,              // 22A  subs r3, #1
        0xD1FD,              // 22C  bne.n 800022a
        0x6008,              // 22E  str r0, [r1, #0]
        0x3A01,              // 230  subs r2, #1
        0xE7F6,              // 232  b.n 8000222
        0xE7FE,              // 234  b.n 8000234
        0x0000,              // 236  .short 0x0000
        0x3000, 0x4000,      // 238  .word 0x40003000
        0x0100, 0x2000,      // 23C  .word 0x20000100
    ],
};

/// Unlocks the flash and erases sector 1 with x32, polling BSY from flash; then programs 1234_5678h
/// at its start. 2000_0000h counts the polls, 2000_0004h SysTick's exceptions, 2000_0008h holds SR
/// afterwards.
pub const FLASH_FROM_FLASH: Program = Program {
    base: 0x0800_0200,
    vectors: &[(15, 0x0800_0249)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2700,              // 204  movs r7, #0
        0x6077,              // 206  str r7, [r6, #4]
        0x4912,              // 208  ldr r1, [pc, #72]
        0xF643, 0x627F,      // 20A  movw r2, #15999
        0x604A,              // 20E  str r2, [r1, #4]
        0x608F,              // 210  str r7, [r1, #8]
        0x2207,              // 212  movs r2, #7
        0x600A,              // 214  str r2, [r1, #0]
        0x4910,              // 216  ldr r1, [pc, #64]
        0x4810,              // 218  ldr r0, [pc, #64]
        0x6048,              // 21A  str r0, [r1, #4]
        0x4810,              // 21C  ldr r0, [pc, #64]
        0x6048,              // 21E  str r0, [r1, #4]
        0x4810,              // 220  ldr r0, [pc, #64]
        0x6108,              // 222  str r0, [r1, #16]
        0x3701,              // 224  adds r7, #1
        0x68C8,              // 226  ldr r0, [r1, #12]
        0x03C0,              // 228  lsls r0, r0, #15
        0xD4FB,              // 22A  bmi.n 8000224
        0x6037,              // 22C  str r7, [r6, #0]
        0xF240, 0x2001,      // 22E  movw r0, #513
        0x6108,              // 232  str r0, [r1, #16]
        0x4A0C,              // 234  ldr r2, [pc, #48]
        0x4B0D,              // 236  ldr r3, [pc, #52]
        0x6013,              // 238  str r3, [r2, #0]
        0x68C8,              // 23A  ldr r0, [r1, #12]
        0x03C0,              // 23C  lsls r0, r0, #15
        0xD4FC,              // 23E  bmi.n 800023a
        0x68C8,              // 240  ldr r0, [r1, #12]
        0x60B0,              // 242  str r0, [r6, #8]
        0xBF30,              // 244  wfi
        0xE7FD,              // 246  b.n 8000244
        0x4909,              // 248 tick:  ldr r1, [pc, #36]
        0x6808,              // 24A  ldr r0, [r1, #0]
        0x3001,              // 24C  adds r0, #1
        0x6008,              // 24E  str r0, [r1, #0]
        0x4770,              // 250  bx lr
        0x0000,              // 252  .short 0x0000
        0xE010, 0xE000,      // 254  .word 0xe000e010
        0x3C00, 0x4002,      // 258  .word 0x40023c00
        0x0123, 0x4567,      // 25C  .word 0x45670123
        0x89AB, 0xCDEF,      // 260  .word 0xcdef89ab
        0x020A, 0x0001,      // 264  .word 0x0001020a
        0x4000, 0x0800,      // 268  .word 0x08004000
        0x5678, 0x1234,      // 26C  .word 0x12345678
        0x0004, 0x2000,      // 270  .word 0x20000004
    ],
};

/// Runs at 2000_1000h: calls 0800_4001h, erases sector 1 from RAM, reads a word of flash once
/// meanwhile if 2000_0100h says so, programs `movs r0, #2; bx lr` and calls again. 2000_0000h:
/// polls; +4, +8: the two results.
pub const FLASH_FROM_RAM: Program = Program {
    base: 0x2000_1000,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 000  mov.w r6, #536870912
        0x2700,              // 004  movs r7, #0
        0x4C11,              // 006  ldr r4, [pc, #68]
        0x47A0,              // 008  blx r4
        0x6070,              // 00A  str r0, [r6, #4]
        0x4910,              // 00C  ldr r1, [pc, #64]
        0x4811,              // 00E  ldr r0, [pc, #68]
        0x6048,              // 010  str r0, [r1, #4]
        0x4811,              // 012  ldr r0, [pc, #68]
        0x6048,              // 014  str r0, [r1, #4]
        0x4811,              // 016  ldr r0, [pc, #68]
        0x6108,              // 018  str r0, [r1, #16]
        0x4811,              // 01A  ldr r0, [pc, #68]
        0x6800,              // 01C  ldr r0, [r0, #0]
        0x2800,              // 01E  cmp r0, #0
        0xD002,              // 020  beq.n 20001028
        0xF04F, 0x6000,      // 022  mov.w r0, #134217728
        0x6800,              // 026  ldr r0, [r0, #0]
        0x3701,              // 028  adds r7, #1
        0x68C8,              // 02A  ldr r0, [r1, #12]
        0x03C0,              // 02C  lsls r0, r0, #15
        0xD4FB,              // 02E  bmi.n 20001028
        0x6037,              // 030  str r7, [r6, #0]
        0xF240, 0x2001,      // 032  movw r0, #513
        0x6108,              // 036  str r0, [r1, #16]
        0x4A0A,              // 038  ldr r2, [pc, #40]
        0x4B0B,              // 03A  ldr r3, [pc, #44]
        0x6013,              // 03C  str r3, [r2, #0]
        0x68C8,              // 03E  ldr r0, [r1, #12]
        0x03C0,              // 040  lsls r0, r0, #15
        0xD4FC,              // 042  bmi.n 2000103e
        0x47A0,              // 044  blx r4
        0x60B0,              // 046  str r0, [r6, #8]
        0xBF30,              // 048  wfi
        0xE7FD,              // 04A  b.n 20001048
        0x4001, 0x0800,      // 04C  .word 0x08004001
        0x3C00, 0x4002,      // 050  .word 0x40023c00
        0x0123, 0x4567,      // 054  .word 0x45670123
        0x89AB, 0xCDEF,      // 058  .word 0xcdef89ab
        0x020A, 0x0001,      // 05C  .word 0x0001020a
        0x0100, 0x2000,      // 060  .word 0x20000100
        0x4000, 0x0800,      // 064  .word 0x08004000
        0x2002, 0x4770,      // 068  .word 0x47702002
    ],
};

/// Jumps to 2000_1000h once 2000_0200h holds 1.
pub const TO_RAM: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0x4802,              // 200  ldr r0, [pc, #8]
        0x6801,              // 202  ldr r1, [r0, #0]
        0x2901,              // 204  cmp r1, #1
        0xD1FC,              // 206  bne.n 8000202
        0x4801,              // 208  ldr r0, [pc, #4]
        0x4700,              // 20A  bx r0
        0x0200, 0x2000,      // 20C  .word 0x20000200
        0x1001, 0x2000,      // 210  .word 0x20001001
    ],
};

/// Bits through their aliases: RCC_AHB1ENR bit 3 (GPIOD), GPIOD_MODER, a bit of RAM; results from
/// 2000_0000h on.
pub const BIT_BAND: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4809,              // 204  ldr r0, [pc, #36]
        0x6030,              // 206  str r0, [r6, #0]
        0x4909,              // 208  ldr r1, [pc, #36]
        0x2001,              // 20A  movs r0, #1
        0x6008,              // 20C  str r0, [r1, #0]
        0x6808,              // 20E  ldr r0, [r1, #0]
        0x6070,              // 210  str r0, [r6, #4]
        0x4908,              // 212  ldr r1, [pc, #32]
        0x6808,              // 214  ldr r0, [r1, #0]
        0x60B0,              // 216  str r0, [r6, #8]
        0x4907,              // 218  ldr r1, [pc, #28]
        0x6808,              // 21A  ldr r0, [r1, #0]
        0x60F0,              // 21C  str r0, [r6, #12]
        0x2000,              // 21E  movs r0, #0
        0x6008,              // 220  str r0, [r1, #0]
        0x4906,              // 222  ldr r1, [pc, #24]
        0x20FF,              // 224  movs r0, #255
        0x6008,              // 226  str r0, [r1, #0]
        0xBF30,              // 228  wfi
        0xE7FD,              // 22A  b.n 8000228
        0x0001, 0x8000,      // 22C  .word 0x80000001
        0x060C, 0x4247,      // 230  .word 0x4247060c
        0x3830, 0x4002,      // 234  .word 0x40023830
        0x007C, 0x2200,      // 238  .word 0x2200007c
        0x0004, 0x2200,      // 23C  .word 0x22000004
    ],
};

/// Touches GPIOD without its clock, TIM2, and GPIOD with it.
pub const PERIPHERALS: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x490C,              // 204  ldr r1, [pc, #48]
        0x6808,              // 206  ldr r0, [r1, #0]
        0x6030,              // 208  str r0, [r6, #0]
        0xF04F, 0x4280,      // 20A  mov.w r2, #1073741824
        0x2001,              // 20E  movs r0, #1
        0x6010,              // 210 again:  str r0, [r2, #0]
        0x4B0A,              // 212  ldr r3, [pc, #40]
        0x681D,              // 214  ldr r5, [r3, #0]
        0x3D01,              // 216  subs r5, #1
        0x601D,              // 218  str r5, [r3, #0]
        0xD1F9,              // 21A  bne.n 8000210
        0x4A08,              // 21C  ldr r2, [pc, #32]
        0x2008,              // 21E  movs r0, #8
        0x6010,              // 220  str r0, [r2, #0]
        0xF04F, 0x7080,      // 222  mov.w r0, #16777216
        0x6008,              // 226  str r0, [r1, #0]
        0xF44F, 0x5080,      // 228  mov.w r0, #4096
        0x6188,              // 22C  str r0, [r1, #24]
        0x6908,              // 22E  ldr r0, [r1, #16]
        0x6030,              // 230  str r0, [r6, #0]
        0xBF30,              // 232  wfi
        0xE7FD,              // 234  b.n 8000232
        0x0000,              // 236  .short 0x0000
        0x0C00, 0x4002,      // 238  .word 0x40020c00
        0x0004, 0x2000,      // 23C  .word 0x20000004
        0x3830, 0x4002,      // 240  .word 0x40023830
    ],
};

/// Works and is interrupted by SysTick every 1 000 cycles, for the comparison of two runs; keeps a
/// checksum of what it saw.
pub const BUSY: Program = Program {
    base: 0x0800_0200,
    vectors: &[(15, 0x0800_0235)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2000,              // 204  movs r0, #0
        0x6030,              // 206  str r0, [r6, #0]
        0x6070,              // 208  str r0, [r6, #4]
        0x490D,              // 20A  ldr r1, [pc, #52]
        0xF240, 0x32E7,      // 20C  movw r2, #999
        0x604A,              // 210  str r2, [r1, #4]
        0x6088,              // 212  str r0, [r1, #8]
        0x2207,              // 214  movs r2, #7
        0x600A,              // 216  str r2, [r1, #0]
        0x2301,              // 218  movs r3, #1
        0x688A,              // 21A  ldr r2, [r1, #8]
        0x4053,              // 21C  eors r3, r2
        0x015C,              // 21E  lsls r4, r3, #5
        0x191B,              // 220  adds r3, r3, r4
        0x6832,              // 222  ldr r2, [r6, #0]
        0x189B,              // 224  adds r3, r3, r2
        0x6073,              // 226  str r3, [r6, #4]
        0xF013, 0x0F40,      // 228  tst.w r3, #64
        0xD0F5,              // 22C  beq.n 800021a
        0xB43F,              // 22E  push {r0, r1, r2, r3, r4, r5}
        0xBC3F,              // 230  pop {r0, r1, r2, r3, r4, r5}
        0xE7F2,              // 232  b.n 800021a
        0xF04F, 0x5100,      // 234 tick:  mov.w r1, #536870912
        0x6808,              // 238  ldr r0, [r1, #0]
        0x3001,              // 23A  adds r0, #1
        0x6008,              // 23C  str r0, [r1, #0]
        0x4770,              // 23E  bx lr
        0xE010, 0xE000,      // 240  .word 0xe000e010
    ],
};

/// Copies a vector table to 2000_1000h, moves VTOR there and calls SVC.
pub const VECTORS_IN_RAM: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4907,              // 204  ldr r1, [pc, #28]
        0x4808,              // 206  ldr r0, [pc, #32]
        0x62C8,              // 208  str r0, [r1, #44]
        0x4A08,              // 20A  ldr r2, [pc, #32]
        0x6011,              // 20C  str r1, [r2, #0]
        0xF3BF, 0x8F4F,      // 20E  dsb sy
        0xF3BF, 0x8F6F,      // 212  isb sy
        0xDF00,              // 216  svc 0
        0xBF30,              // 218  wfi
        0xE7FD,              // 21A  b.n 8000218
        0x204D,              // 21C handler:  movs r0, #77
        0x6030,              // 21E  str r0, [r6, #0]
        0x4770,              // 220  bx lr
        0x0000,              // 222  .short 0x0000
        0x1000, 0x2000,      // 224  .word 0x20001000
        0x021D, 0x0800,      // 228  .word 0x0800021d
        0xED08, 0xE000,      // 22C  .word 0xe000ed08
    ],
};

/// WFE ends by itself sooner or later; 2000_0000h counts.
pub const EVENTS: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2000,              // 204  movs r0, #0
        0xBF20,              // 206  wfe
        0x3001,              // 208  adds r0, #1
        0x6030,              // 20A  str r0, [r6, #0]
        0xE7FB,              // 20C  b.n 8000206
        0xBF00,              // 20E  nop
    ],
};

/// SCR.SLEEPONEXIT: the thread never runs again; the handler counts.
pub const SLEEPS_ON_EXIT: Program = Program {
    base: 0x0800_0200,
    vectors: &[(15, 0x0800_022B)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2000,              // 204  movs r0, #0
        0x6030,              // 206  str r0, [r6, #0]
        0x6070,              // 208  str r0, [r6, #4]
        0x490A,              // 20A  ldr r1, [pc, #40]
        0x2002,              // 20C  movs r0, #2
        0x6008,              // 20E  str r0, [r1, #0]
        0x2000,              // 210  movs r0, #0
        0x4909,              // 212  ldr r1, [pc, #36]
        0xF643, 0x627F,      // 214  movw r2, #15999
        0x604A,              // 218  str r2, [r1, #4]
        0x6088,              // 21A  str r0, [r1, #8]
        0x2207,              // 21C  movs r2, #7
        0x600A,              // 21E  str r2, [r1, #0]
        0xBF30,              // 220  wfi
        0x6870,              // 222  ldr r0, [r6, #4]
        0x3001,              // 224  adds r0, #1
        0x6070,              // 226  str r0, [r6, #4]
        0xE7FB,              // 228  b.n 8000222
        0x6830,              // 22A tick:  ldr r0, [r6, #0]
        0x3001,              // 22C  adds r0, #1
        0x6030,              // 22E  str r0, [r6, #0]
        0x4770,              // 230  bx lr
        0x0000,              // 232  .short 0x0000
        0xED10, 0xE000,      // 234  .word 0xe000ed10
        0xE010, 0xE000,      // 238  .word 0xe000e010
    ],
};

/// Copies `movs r0, #1; bx lr` to 2000_1000h, calls it, overwrites it with `movs r0, #2; bx lr`,
/// calls it again.
pub const WRITES_ITS_OWN_CODE: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4C0A,              // 204  ldr r4, [pc, #40]
        0x480B,              // 206  ldr r0, [pc, #44]
        0x6020,              // 208  str r0, [r4, #0]
        0xF3BF, 0x8F4F,      // 20A  dsb sy
        0xF3BF, 0x8F6F,      // 20E  isb sy
        0x3401,              // 212  adds r4, #1
        0x47A0,              // 214  blx r4
        0x6030,              // 216  str r0, [r6, #0]
        0x3C01,              // 218  subs r4, #1
        0x4807,              // 21A  ldr r0, [pc, #28]
        0x6020,              // 21C  str r0, [r4, #0]
        0xF3BF, 0x8F4F,      // 21E  dsb sy
        0xF3BF, 0x8F6F,      // 222  isb sy
        0x3401,              // 226  adds r4, #1
        0x47A0,              // 228  blx r4
        0x6070,              // 22A  str r0, [r6, #4]
        0xBF30,              // 22C  wfi
        0xE7FD,              // 22E  b.n 800022c
        0x1000, 0x2000,      // 230  .word 0x20001000
        0x2001, 0x4770,      // 234  .word 0x47702001
        0x2002, 0x4770,      // 238  .word 0x47702002
    ],
};

/// Pends line 0 (priority 80h) under BASEPRI 80h and drops its privilege; counts at 2000_0000h, up
/// to 1 000, then SVC clears BASEPRI. The handlers log at 2000_0004h (line 0: the count) and
/// 2000_0008h (CONTROL as SVC sees it).
pub const UNPRIVILEGED: Program = Program {
    base: 0x0800_0200,
    vectors: &[(11, 0x0800_0241), (16, 0x0800_023B)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2400,              // 204  movs r4, #0
        0x6074,              // 206  str r4, [r6, #4]
        0x4D11,              // 208  ldr r5, [pc, #68]
        0x2001,              // 20A  movs r0, #1
        0x6028,              // 20C  str r0, [r5, #0]
        0x4911,              // 20E  ldr r1, [pc, #68]
        0x2080,              // 210  movs r0, #128
        0x7008,              // 212  strb r0, [r1, #0]
        0xF380, 0x8811,      // 214  msr BASEPRI, r0
        0x2201,              // 218  movs r2, #1
        0x490F,              // 21A  ldr r1, [pc, #60]
        0x600A,              // 21C  str r2, [r1, #0]
        0xF382, 0x8814,      // 21E  msr CONTROL, r2
        0xF3BF, 0x8F6F,      // 222  isb sy
        0x3401,              // 226  adds r4, #1
        0x6034,              // 228  str r4, [r6, #0]
        0x2000,              // 22A  movs r0, #0
        0xF380, 0x8811,      // 22C  msr BASEPRI, r0
        0xF5B4, 0x7F7A,      // 230  cmp.w r4, #1000
        0xD1F7,              // 234  bne.n 8000226
        0xDF00,              // 236  svc 0
        0xE7FE,              // 238  b.n 8000238
        0x6830,              // 23A line0:  ldr r0, [r6, #0]
        0x6070,              // 23C  str r0, [r6, #4]
        0x4770,              // 23E  bx lr
        0x2000,              // 240 call:  movs r0, #0
        0xF380, 0x8811,      // 242  msr BASEPRI, r0
        0xF3EF, 0x8014,      // 246  mrs r0, CONTROL
        0x60B0,              // 24A  str r0, [r6, #8]
        0x4770,              // 24C  bx lr
        0x0000,              // 24E  .short 0x0000
        0xE100, 0xE000,      // 250  .word 0xe000e100
        0xE400, 0xE000,      // 254  .word 0xe000e400
        0xE200, 0xE000,      // 258  .word 0xe000e200
    ],
};

/// Line 0's handler sets FAULTMASK and returns; the thread logs FAULTMASK.
pub const FAULTMASK: Program = Program {
    base: 0x0800_0200,
    vectors: &[(16, 0x0800_0223)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x4D09,              // 204  ldr r5, [pc, #36]
        0x2001,              // 206  movs r0, #1
        0x6028,              // 208  str r0, [r5, #0]
        0x4909,              // 20A  ldr r1, [pc, #36]
        0x2000,              // 20C  movs r0, #0
        0x6008,              // 20E  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 210  dsb sy
        0xF3BF, 0x8F6F,      // 214  isb sy
        0xF3EF, 0x8013,      // 218  mrs r0, FAULTMASK
        0x6030,              // 21C  str r0, [r6, #0]
        0xBF30,              // 21E  wfi
        0xE7FD,              // 220  b.n 800021e
        0xB671,              // 222 line0:  cpsid f
        0xF3EF, 0x8013,      // 224  mrs r0, FAULTMASK
        0x6070,              // 228  str r0, [r6, #4]
        0x4770,              // 22A  bx lr
        0xE100, 0xE000,      // 22C  .word 0xe000e100
        0xEF00, 0xE000,      // 230  .word 0xe000ef00
    ],
};

/// Writes a wrong key to FLASH_KEYR.
pub const WRONG_KEY: Program = Program {
    base: 0x0800_0200,
    vectors: &[(3, 0x0800_0211)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2000,              // 204  movs r0, #0
        0x6030,              // 206  str r0, [r6, #0]
        0x4903,              // 208  ldr r1, [pc, #12]
        0x6008,              // 20A  str r0, [r1, #0]
        0x3001,              // 20C  adds r0, #1
        0xE7FD,              // 20E  b.n 800020c
        0xF3EF, 0x8005,      // 210 hard:  mrs r0, IPSR
        0x6030,              // 214  str r0, [r6, #0]
        0xE7FE,              // 216  b.n 8000216
        0x3C04, 0x4002,      // 218  .word 0x40023c04
    ],
};

/// Follows a script at 2000_0100h, of pairs of words: address and value of a store; 1 or 2 and a
/// value for FAULTMASK; 0 for the end. Logs then from 2000_0004h on: FLASH_CR, FLASH_OPTCR, CFSR,
/// HFSR, BFAR. The handler of BusFault and HardFault counts at 2000_0000h, logs IPSR and the stacked
/// PC at 2000_0018h, and goes on behind the store if that is what the PC points to.
pub const STORES_OF_A_SCRIPT: Program = Program {
    base: 0x0800_0200,
    vectors: &[(3, 0x0800_0249), (5, 0x0800_0249)],
    code: &[
        0xF04F, 0x5600,      // 200 start:  mov.w r6, #536870912
        0x2000,              // 204  movs r0, #0
        0x6030,              // 206  str r0, [r6, #0]
        0x4D17,              // 208  ldr r5, [pc, #92]
        0x6829,              // 20A next:  ldr r1, [r5, #0]
        0x6868,              // 20C  ldr r0, [r5, #4]
        0x3508,              // 20E  adds r5, #8
        0xB161,              // 210  cbz r1, 800022c
        0x2902,              // 212  cmp r1, #2
        0xD905,              // 214  bls.n 8000222
        0x6008,              // 216  str r0, [r1, #0]
        0xF3BF, 0x8F4F,      // 218 behind:  dsb sy
        0xF3BF, 0x8F6F,      // 21C  isb sy
        0xE7F3,              // 220  b.n 800020a
        0xF380, 0x8813,      // 222 mask:  msr FAULTMASK, r0
        0xF3BF, 0x8F6F,      // 226  isb sy
        0xE7EE,              // 22A  b.n 800020a
        0x490F,              // 22C done:  ldr r1, [pc, #60]
        0x6908,              // 22E  ldr r0, [r1, #16]
        0x6070,              // 230  str r0, [r6, #4]
        0x6948,              // 232  ldr r0, [r1, #20]
        0x60B0,              // 234  str r0, [r6, #8]
        0x490E,              // 236  ldr r1, [pc, #56]
        0x6808,              // 238  ldr r0, [r1, #0]
        0x60F0,              // 23A  str r0, [r6, #12]
        0x6848,              // 23C  ldr r0, [r1, #4]
        0x6130,              // 23E  str r0, [r6, #16]
        0x6908,              // 240  ldr r0, [r1, #16]
        0x6170,              // 242  str r0, [r6, #20]
        0xBF30,              // 244  wfi
        0xE7FD,              // 246  b.n 8000244
        0x6830,              // 248 fault:  ldr r0, [r6, #0]
        0x3001,              // 24A  adds r0, #1
        0x6030,              // 24C  str r0, [r6, #0]
        0xF3EF, 0x8005,      // 24E  mrs r0, IPSR
        0x61B0,              // 252  str r0, [r6, #24]
        0x9806,              // 254  ldr r0, [sp, #24]
        0x61F0,              // 256  str r0, [r6, #28]
        0x4905,              // 258  ldr r1, [pc, #20]
        0x680A,              // 25A  ldr r2, [r1, #0]
        0x0592,              // 25C  lsls r2, r2, #22
        0xD501,              // 25E  bpl.n 8000264
        0x3002,              // 260  adds r0, #2
        0x9006,              // 262  str r0, [sp, #24]
        0x4770,              // 264 back:  bx lr
        0xBF00,              // 266  nop
        0x0100, 0x2000,      // 268  .word 0x20000100
        0x3C00, 0x4002,      // 26C  .word 0x40023c00
        0xED28, 0xE000,      // 270  .word 0xe000ed28
    ],
};

/// Runs at 2000_1000h: SysTick every millisecond with its handler in RAM and the vector table where
/// 2000_0100h says (its SysTick vector is written there if that is RAM); erases sector 1 with
/// EOPIE; the flash's handler logs the number of ticks until then at 2000_0004h and SR at
/// 2000_0008h.
pub const ERASE_UNDER_INTERRUPTS: Program = Program {
    base: 0x2000_1000,
    vectors: &[],
    code: &[
        0xF04F, 0x5600,      // 000  mov.w r6, #536870912
        0x2700,              // 004  movs r7, #0
        0x6037,              // 006  str r7, [r6, #0]
        0x6077,              // 008  str r7, [r6, #4]
        0x4815,              // 00A  ldr r0, [pc, #84]
        0x6800,              // 00C  ldr r0, [r0, #0]
        0x4915,              // 00E  ldr r1, [pc, #84]
        0x6008,              // 010  str r0, [r1, #0]
        0xF04F, 0x5100,      // 012  mov.w r1, #536870912
        0x4288,              // 016  cmp r0, r1
        0xD303,              // 018  bcc.n 20001022
        0x4913,              // 01A  ldr r1, [pc, #76]
        0x63C1,              // 01C  str r1, [r0, #60]
        0x4913,              // 01E  ldr r1, [pc, #76]
        0x6501,              // 020  str r1, [r0, #80]
        0x4913,              // 022  ldr r1, [pc, #76]
        0x2010,              // 024  movs r0, #16
        0x6008,              // 026  str r0, [r1, #0]
        0x4912,              // 028  ldr r1, [pc, #72]
        0xF643, 0x627F,      // 02A  movw r2, #15999
        0x604A,              // 02E  str r2, [r1, #4]
        0x608F,              // 030  str r7, [r1, #8]
        0x2207,              // 032  movs r2, #7
        0x600A,              // 034  str r2, [r1, #0]
        0x4910,              // 036  ldr r1, [pc, #64]
        0x4810,              // 038  ldr r0, [pc, #64]
        0x6048,              // 03A  str r0, [r1, #4]
        0x4810,              // 03C  ldr r0, [pc, #64]
        0x6048,              // 03E  str r0, [r1, #4]
        0x4810,              // 040  ldr r0, [pc, #64]
        0x6108,              // 042  str r0, [r1, #16]
        0xBF30,              // 044  wfi
        0xE7FD,              // 046  b.n 20001044
        0x6830,              // 048 tick:  ldr r0, [r6, #0]
        0x3001,              // 04A  adds r0, #1
        0x6030,              // 04C  str r0, [r6, #0]
        0x4770,              // 04E  bx lr
        0x6830,              // 050 done:  ldr r0, [r6, #0]
        0x6070,              // 052  str r0, [r6, #4]
        0x68C8,              // 054  ldr r0, [r1, #12]
        0x60B0,              // 056  str r0, [r6, #8]
        0x2001,              // 058  movs r0, #1
        0x60C8,              // 05A  str r0, [r1, #12]
        0x4770,              // 05C  bx lr
        0x0000,              // 05E  .short 0x0000
        0x0100, 0x2000,      // 060  .word 0x20000100
        0xED08, 0xE000,      // 064  .word 0xe000ed08
        0x1049, 0x2000,      // 068  .word 0x20001049
        0x1051, 0x2000,      // 06C  .word 0x20001051
        0xE100, 0xE000,      // 070  .word 0xe000e100
        0xE010, 0xE000,      // 074  .word 0xe000e010
        0x3C00, 0x4002,      // 078  .word 0x40023c00
        0x0123, 0x4567,      // 07C  .word 0x45670123
        0x89AB, 0xCDEF,      // 080  .word 0xcdef89ab
        0x020A, 0x0101,      // 084  .word 0x0101020a
    ],
};

/// Switches to 168 MHz (8 MHz crystal, M 8, N 336, P 2, APB1 /4, APB2 /2, 5 wait states if
/// 2000_0100h says so) by polling, then counts SysTick's 16 800 cycles at 2000_0000h and CYCCNT
/// over 1 000 000 rounds of a two-cycle loop at 2000_0004h.
pub const SCALES_THE_CLOCK: Program = Program {
    base: 0x0800_0200,
    vectors: &[(15, 0x0800_0269)],
    code: &[
        0xF04F, 0x5600,      // 200  mov.w r6, #536870912
        0x2700,              // 204  movs r7, #0
        0x6037,              // 206  str r7, [r6, #0]
        0x4819,              // 208  ldr r0, [pc, #100]
        0x6802,              // 20A  ldr r2, [r0, #0]
        0x4919,              // 20C  ldr r1, [pc, #100]
        0x600A,              // 20E  str r2, [r1, #0]
        0x4919,              // 210  ldr r1, [pc, #100]
        0x481A,              // 212  ldr r0, [pc, #104]
        0x6008,              // 214  str r0, [r1, #0]
        0x6808,              // 216  ldr r0, [r1, #0]
        0x0380,              // 218  lsls r0, r0, #14
        0xD5FC,              // 21A  bpl.n 8000216
        0x4818,              // 21C  ldr r0, [pc, #96]
        0x6048,              // 21E  str r0, [r1, #4]
        0x4818,              // 220  ldr r0, [pc, #96]
        0x6008,              // 222  str r0, [r1, #0]
        0x6808,              // 224  ldr r0, [r1, #0]
        0x0180,              // 226  lsls r0, r0, #6
        0xD5FC,              // 228  bpl.n 8000224
        0xF249, 0x4002,      // 22A  movw r0, #37890
        0x6088,              // 22E  str r0, [r1, #8]
        0x6888,              // 230  ldr r0, [r1, #8]
        0xF000, 0x000C,      // 232  and.w r0, r0, #12
        0x2808,              // 236  cmp r0, #8
        0xD1FA,              // 238  bne.n 8000230
        0x4913,              // 23A  ldr r1, [pc, #76]
        0xF04F, 0x7080,      // 23C  mov.w r0, #16777216
        0x6008,              // 240  str r0, [r1, #0]
        0x4912,              // 242  ldr r1, [pc, #72]
        0x2001,              // 244  movs r0, #1
        0x6008,              // 246  str r0, [r1, #0]
        0x684A,              // 248  ldr r2, [r1, #4]
        0x4B11,              // 24A  ldr r3, [pc, #68]
        0x3B01,              // 24C  subs r3, #1
        0xD1FD,              // 24E  bne.n 800024c
        0x6848,              // 250  ldr r0, [r1, #4]
        0x1A80,              // 252  subs r0, r0, r2
        0x6070,              // 254  str r0, [r6, #4]
        0x490F,              // 256  ldr r1, [pc, #60]
        0xF244, 0x129F,      // 258  movw r2, #16799
        0x604A,              // 25C  str r2, [r1, #4]
        0x608F,              // 25E  str r7, [r1, #8]
        0x2207,              // 260  movs r2, #7
        0x600A,              // 262  str r2, [r1, #0]
        0xBF30,              // 264  wfi
        0xE7FD,              // 266  b.n 8000264
        0x6830,              // 268 tick:  ldr r0, [r6, #0]
        0x3001,              // 26A  adds r0, #1
        0x6030,              // 26C  str r0, [r6, #0]
        0x4770,              // 26E  bx lr
        0x0100, 0x2000,      // 270  .word 0x20000100
        0x3C00, 0x4002,      // 274  .word 0x40023c00
        0x3800, 0x4002,      // 278  .word 0x40023800
        0x0083, 0x0001,      // 27C  .word 0x00010083
        0x5408, 0x0040,      // 280  .word 0x00405408
        0x0083, 0x0101,      // 284  .word 0x01010083
        0xEDFC, 0xE000,      // 288  .word 0xe000edfc
        0x1000, 0xE000,      // 28C  .word 0xe0001000
        0x4240, 0x000F,      // 290  .word 0x000f4240
        0xE010, 0xE000,      // 294  .word 0xe000e010
    ],
};

/// 100 000 rounds of an IT block that lies across a page border, interrupted every 67 cycles by a
/// handler that changes the flags. Every second round adds 7, 1, 3 and 5 to the words at
/// 2000_0000h.
pub const CONDITIONS: Program = Program {
    base: 0x0800_0FDC,
    vectors: &[(15, 0x0800_1013)],
    code: &[
        0x2000,              // FDC  movs r0, #0
        0x2400,              // FDE  movs r4, #0
        0x2500,              // FE0  movs r5, #0
        0x2600,              // FE2  movs r6, #0
        0x2700,              // FE4  movs r7, #0
        0x2300,              // FE6  movs r3, #0
        0x490D,              // FE8  ldr r1, [pc, #52]
        0x2242,              // FEA  movs r2, #66
        0x604A,              // FEC  str r2, [r1, #4]
        0x6088,              // FEE  str r0, [r1, #8]
        0x2207,              // FF0  movs r2, #7
        0x600A,              // FF2  str r2, [r1, #0]
        0x4A0B,              // FF4  ldr r2, [pc, #44]
        0x3401,              // FF6 loop:  adds r4, #1
        0x07E0,              // FF8  lsls r0, r4, #31
        0xBF1F,              // FFA  itttt ne
        0x3501,              // FFC  addne r5, #1
        0x3603,              // FFE  addne r6, #3
        0x3705,              // 000  addne r7, #5
        0x3307,              // 002  addne r3, #7
        0x4294,              // 004  cmp r4, r2
        0xD1F6,              // 006  bne.n 8000ff6
        0xF04F, 0x5000,      // 008  mov.w r0, #536870912
        0xC0E8,              // 00C  stmia r0!, {r3, r5, r6, r7}
        0xBF30,              // 00E  wfi
        0xE7FD,              // 010  b.n 800100e
        0x4805,              // 012 tick:  ldr r0, [pc, #20]
        0x6801,              // 014  ldr r1, [r0, #0]
        0x3101,              // 016  adds r1, #1
        0x6001,              // 018  str r1, [r0, #0]
        0x4289,              // 01A  cmp r1, r1
        0x4770,              // 01C  bx lr
        0x0000,              // 01E  .short 0x0000
        0xE010, 0xE000,      // 020  .word 0xe000e010
        0x86A0, 0x0001,      // 024  .word 0x000186a0
        0x0010, 0x2000,      // 028  .word 0x20000010
    ],
};

/// In 64 rounds the first load from a page of flash, within an IT block; behind the block four
/// additions of 1. Their sum at 2000_0000h.
pub const CONDITIONAL_LOADS: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0x4A0B,              // 200  ldr r2, [pc, #44]
        0x2500,              // 202  movs r5, #0
        0x2640,              // 204  movs r6, #64
        0x4292,              // 206 loop:  cmp r2, r2
        0xBF07,              // 208  ittee eq
        0x6811,              // 20A  ldreq r1, [r2, #0]
        0x2300,              // 20C  moveq r3, #0
        0x2301,              // 20E  movne r3, #1
        0x2302,              // 210  movne r3, #2
        0xE7FF,              // 212  b.n 8000214
        0x3501,              // 214  adds r5, #1
        0x3501,              // 216  adds r5, #1
        0x3501,              // 218  adds r5, #1
        0x3501,              // 21A  adds r5, #1
        0xF502, 0x5280,      // 21C  add.w r2, r2, #4096
        0x3E01,              // 220  subs r6, #1
        0xD1F0,              // 222  bne.n 8000206
        0xF04F, 0x5000,      // 224  mov.w r0, #536870912
        0x6005,              // 228  str r5, [r0, #0]
        0xBF30,              // 22A  wfi
        0xE7FD,              // 22C  b.n 800022a
        0x0000,              // 22E  .short 0x0000
        0x0000, 0x0801,      // 230  .word 0x08010000
    ],
};

/// Reads the word at 0801_0000h, then calls the function there again and again, and keeps its
/// result at 2000_0000h.
pub const CALLS_WHAT_IT_HAS_READ: Program = Program {
    base: 0x0800_0200,
    vectors: &[],
    code: &[
        0x4C03,              // 200  ldr r4, [pc, #12]
        0xF04F, 0x5500,      // 202  mov.w r5, #536870912
        0x6821,              // 206  ldr r1, [r4, #0]
        0x3401,              // 208  adds r4, #1
        0x47A0,              // 20A loop:  blx r4
        0x6028,              // 20C  str r0, [r5, #0]
        0xE7FC,              // 20E  b.n 800020a
        0x0000, 0x0801,      // 210  .word 0x08010000
    ],
};

/// Sets a breakpoint, comes to it, and then to a BKPT. What DEMCR is given is taken from
/// 2000_0100h, the comparator from 2000_0104h (0: neither it nor the unit is touched), whether
/// PRIMASK is set from 2000_0108h. Each DebugMonitor logs the PC that was stacked and DFSR, from
/// 2000_0200h on, turns the breakpoint off, skips a BKPT, and asks for as many steps as 2000_010Ch
/// says. A HardFault logs the PC, HFSR and DFSR there, and stays.
pub const BREAKPOINTS: Program = Program {
    base: 0x0800_0200,
    vectors: &[(3, 0x0800_0279), (12, 0x0800_0241)],
    code: &[
        0xF04F, 0x5400,      // 200 mov.w r4, #536870912
        0xF504, 0x7700,      // 204 add.w r7, r4, #512
        0x4D1F,              // 208 ldr r5, [pc, #124]
        0x4E20,              // 20A ldr r6, [pc, #128]
        0xF8D4, 0x0100,      // 20C ldr.w r0, [r4, #256]
        0x6028,              // 210 str r0, [r5, #0]
        0xF8D4, 0x0104,      // 212 ldr.w r0, [r4, #260]
        0xB110,              // 216 cbz r0, 800021e
        0x60B0,              // 218 str r0, [r6, #8]
        0x2003,              // 21A movs r0, #3
        0x6030,              // 21C str r0, [r6, #0]
        0xF8D4, 0x0108,      // 21E ldr.w r0, [r4, #264]
        0xB100,              // 222 cbz r0, 8000226
        0xB672,              // 224 cpsid i
        0x2100,              // 226 movs r1, #0
        0xF3BF, 0x8F6F,      // 228 isb sy
        0x3101,              // 22C target:  adds r1, #1
        0xE000,              // 22E b.n 8000232
        0x3120,              // 230 adds r1, #32
        0x6021,              // 232 str r1, [r4, #0]
        0x3110,              // 234 adds r1, #16
        0x6061,              // 236 str r1, [r4, #4]
        0xBE07,              // 238 bkpt 0x0007
        0x60A1,              // 23A str r1, [r4, #8]
        0xBF30,              // 23C wfi
        0xE7FD,              // 23E b.n 800023c
        0x9806,              // 240 monitor:  ldr r0, [sp, #24]
        0x6038,              // 242 str r0, [r7, #0]
        0x4A12,              // 244 ldr r2, [pc, #72]
        0x6810,              // 246 ldr r0, [r2, #0]
        0x6078,              // 248 str r0, [r7, #4]
        0x6010,              // 24A str r0, [r2, #0]
        0x3708,              // 24C adds r7, #8
        0x2002,              // 24E movs r0, #2
        0x6030,              // 250 str r0, [r6, #0]
        0x9806,              // 252 ldr r0, [sp, #24]
        0x8800,              // 254 ldrh r0, [r0, #0]
        0x0A00,              // 256 lsrs r0, r0, #8
        0x28BE,              // 258 cmp r0, #190
        0xD102,              // 25A bne.n 8000262
        0x9806,              // 25C ldr r0, [sp, #24]
        0x3002,              // 25E adds r0, #2
        0x9006,              // 260 str r0, [sp, #24]
        0x480C,              // 262 ldr r0, [pc, #48]
        0xF8D4, 0x310C,      // 264 ldr.w r3, [r4, #268]
        0xB123,              // 268 cbz r3, 8000274
        0x3B01,              // 26A subs r3, #1
        0xF8C4, 0x310C,      // 26C str.w r3, [r4, #268]
        0xF440, 0x2080,      // 270 orr.w r0, r0, #262144
        0x6028,              // 274 str r0, [r5, #0]
        0x4770,              // 276 bx lr
        0x9806,              // 278 fault:  ldr r0, [sp, #24]
        0x6038,              // 27A str r0, [r7, #0]
        0x4A06,              // 27C ldr r2, [pc, #24]
        0x6810,              // 27E ldr r0, [r2, #0]
        0x6078,              // 280 str r0, [r7, #4]
        0x6850,              // 282 ldr r0, [r2, #4]
        0x60B8,              // 284 str r0, [r7, #8]
        0xE7FE,              // 286 b.n 8000286
        0xEDFC, 0xE000,      // 288 .word 0xe000edfc
        0x2000, 0xE000,      // 28C .word 0xe0002000
        0xED30, 0xE000,      // 290 .word 0xe000ed30
        0x0000, 0x0101,      // 294 .word 0x01010000
        0xED2C, 0xE000,      // 298 .word 0xe000ed2c
    ],
};

/// TIM3 counts microseconds in its 16 bits. The handler counts the overflows at 2000_0000h and the
/// matches of channel 1, in the middle of the range, at 2000_0004h.
pub const TIMER_HALVES: Program = Program {
    base: 0x0800_0200,
    vectors: &[(45, 0x0800_023D)],
    code: &[
        0xF04F, 0x5400,      // 200  mov.w r4, #536870912
        0x2000,              // 204  movs r0, #0
        0x6020,              // 206  str r0, [r4, #0]
        0x6060,              // 208  str r0, [r4, #4]
        0x4D15,              // 20A  ldr r5, [pc, #84]
        0x2002,              // 20C  movs r0, #2
        0x6428,              // 20E  str r0, [r5, #64]
        0x4E14,              // 210  ldr r6, [pc, #80]
        0x200F,              // 212  movs r0, #15
        0x62B0,              // 214  str r0, [r6, #40]
        0x2004,              // 216  movs r0, #4
        0x6030,              // 218  str r0, [r6, #0]
        0x2001,              // 21A  movs r0, #1
        0x6170,              // 21C  str r0, [r6, #20]
        0xF44F, 0x4000,      // 21E  mov.w r0, #32768
        0x6370,              // 222  str r0, [r6, #52]
        0x2003,              // 224  movs r0, #3
        0x60F0,              // 226  str r0, [r6, #12]
        0xF04F, 0x21E0,      // 228  mov.w r1, #3758153728
        0xF04F, 0x5000,      // 22C  mov.w r0, #536870912
        0xF8C1, 0x0100,      // 230  str.w r0, [r1, #256]
        0x2001,              // 234  movs r0, #1
        0x6030,              // 236  str r0, [r6, #0]
        0xBF30,              // 238  wfi
        0xE7FD,              // 23A  b.n 8000238
        0x4909,              // 23C tick:  ldr r1, [pc, #36]
        0xF04F, 0x5200,      // 23E  mov.w r2, #536870912
        0x6908,              // 242  ldr r0, [r1, #16]
        0x43C3,              // 244  mvns r3, r0
        0x610B,              // 246  str r3, [r1, #16]
        0x07C3,              // 248  lsls r3, r0, #31
        0xD502,              // 24A  bpl.n 8000252
        0x6813,              // 24C  ldr r3, [r2, #0]
        0x3301,              // 24E  adds r3, #1
        0x6013,              // 250  str r3, [r2, #0]
        0x0783,              // 252  lsls r3, r0, #30
        0xD502,              // 254  bpl.n 800025c
        0x6853,              // 256  ldr r3, [r2, #4]
        0x3301,              // 258  adds r3, #1
        0x6053,              // 25A  str r3, [r2, #4]
        0x4770,              // 25C  bx lr
        0x0000,              // 25E  .short 0x0000
        0x3800, 0x4002,      // 260  .word 0x40023800
        0x0400, 0x4000,      // 264  .word 0x40000400
    ],
};

/// TIM2 has a period of 16 000 cycles; the handler counts at 2000_0000h and leaves the counter at
/// 2000_0004h. The program writes to port D all the time and never sleeps.
pub const TIMER_PERIOD: Program = Program {
    base: 0x0800_0200,
    vectors: &[(44, 0x0800_023B)],
    code: &[
        0xF04F, 0x5400,      // 200  mov.w r4, #536870912
        0x2000,              // 204  movs r0, #0
        0x6020,              // 206  str r0, [r4, #0]
        0x4D12,              // 208  ldr r5, [pc, #72]
        0x2008,              // 20A  movs r0, #8
        0x6328,              // 20C  str r0, [r5, #48]
        0x2001,              // 20E  movs r0, #1
        0x6428,              // 210  str r0, [r5, #64]
        0xF04F, 0x4680,      // 212  mov.w r6, #1073741824
        0xF643, 0x607F,      // 216  movw r0, #15999
        0x62F0,              // 21A  str r0, [r6, #44]
        0x2001,              // 21C  movs r0, #1
        0x60F0,              // 21E  str r0, [r6, #12]
        0xF04F, 0x21E0,      // 220  mov.w r1, #3758153728
        0xF04F, 0x5080,      // 224  mov.w r0, #268435456
        0xF8C1, 0x0100,      // 228  str.w r0, [r1, #256]
        0x2001,              // 22C  movs r0, #1
        0x6030,              // 22E  str r0, [r6, #0]
        0x4F09,              // 230  ldr r7, [pc, #36]
        0x6178,              // 232  str r0, [r7, #20]
        0x6178,              // 234  str r0, [r7, #20]
        0x6178,              // 236  str r0, [r7, #20]
        0xE7FB,              // 238  b.n 8000232
        0xF04F, 0x4180,      // 23A tick:  mov.w r1, #1073741824
        0xF04F, 0x5200,      // 23E  mov.w r2, #536870912
        0x2300,              // 242  movs r3, #0
        0x610B,              // 244  str r3, [r1, #16]
        0x6813,              // 246  ldr r3, [r2, #0]
        0x3301,              // 248  adds r3, #1
        0x6013,              // 24A  str r3, [r2, #0]
        0x6A4B,              // 24C  ldr r3, [r1, #36]
        0x6053,              // 24E  str r3, [r2, #4]
        0x4770,              // 250  bx lr
        0x0000,              // 252  .short 0x0000
        0x3800, 0x4002,      // 254  .word 0x40023800
        0x0C00, 0x4002,      // 258  .word 0x40020c00
    ],
};

/// Runs at 2000_1000h. Carries out the stores at 2000_0100h: pairs of address and value, ended by
/// an address of 0 with any value. The next three words are an address, a mask and a value. The
/// program writes to port D all the time, until the word at the address, masked, has the value, or
/// an interrupt comes (its vector is 2000_1027h). It keeps CYCCNT at 2000_0000h when it starts to
/// wait and at 2000_0004h when it has seen the event.
pub const WRITES_AND_WAITS: Program = Program {
    base: 0x2000_1000,
    vectors: &[],
    code: &[
        0xF04F, 0x5400,      // 000  mov.w r4, #536870912
        0x4B09,              // 004  ldr r3, [pc, #36]
        0x4F0A,              // 006  ldr r7, [pc, #40]
        0xF504, 0x7580,      // 008  add.w r5, r4, #256
        0xCD03,              // 00C next:  ldmia r5!, {r0, r1}
        0xB108,              // 00E  cbz r0, 20001014
        0x6001,              // 010  str r1, [r0, #0]
        0xE7FB,              // 012  b.n 2000100c
        0xE895, 0x0007,      // 014 wait:  ldmia.w r5, {r0, r1, r2}
        0x685E,              // 018  ldr r6, [r3, #4]
        0x6026,              // 01A  str r6, [r4, #0]
        0x617E,              // 01C poll:  str r6, [r7, #20]
        0x6806,              // 01E  ldr r6, [r0, #0]
        0x400E,              // 020  ands r6, r1
        0x4296,              // 022  cmp r6, r2
        0xD1FA,              // 024  bne.n 2000101c
        0x685E,              // 026 seen:  ldr r6, [r3, #4]
        0x6066,              // 028  str r6, [r4, #4]
        0xE7FE,              // 02A  b.n 2000102a
        0x1000, 0xE000,      // 02C  .word 0xe0001000
        0x0C00, 0x4002,      // 030  .word 0x40020c00
    ],
};

/// Falling edges at PC13 through EXTI line 13. The handler counts them at 2000_0000h and leaves the
/// pending lines at 2000_0004h.
pub const BUTTON: Program = Program {
    base: 0x0800_0200,
    vectors: &[(56, 0x0800_0237)],
    code: &[
        0xF04F, 0x5400,      // 200  mov.w r4, #536870912
        0x2000,              // 204  movs r0, #0
        0x6020,              // 206  str r0, [r4, #0]
        0x4D10,              // 208  ldr r5, [pc, #64]
        0x2004,              // 20A  movs r0, #4
        0x6328,              // 20C  str r0, [r5, #48]
        0xF44F, 0x4080,      // 20E  mov.w r0, #16384
        0x6468,              // 212  str r0, [r5, #68]
        0x4E0E,              // 214  ldr r6, [pc, #56]
        0x2020,              // 216  movs r0, #32
        0x6170,              // 218  str r0, [r6, #20]
        0xF506, 0x6680,      // 21A  add.w r6, r6, #1024
        0xF44F, 0x5000,      // 21E  mov.w r0, #8192
        0x60F0,              // 222  str r0, [r6, #12]
        0x6030,              // 224  str r0, [r6, #0]
        0xF04F, 0x21E0,      // 226  mov.w r1, #3758153728
        0xF44F, 0x7080,      // 22A  mov.w r0, #256
        0xF8C1, 0x0104,      // 22E  str.w r0, [r1, #260]
        0xBF30,              // 232  wfi
        0xE7FD,              // 234  b.n 8000232
        0x4907,              // 236 edge:  ldr r1, [pc, #28]
        0xF04F, 0x5200,      // 238  mov.w r2, #536870912
        0x694B,              // 23C  ldr r3, [r1, #20]
        0x614B,              // 23E  str r3, [r1, #20]
        0x6053,              // 240  str r3, [r2, #4]
        0x6813,              // 242  ldr r3, [r2, #0]
        0x3301,              // 244  adds r3, #1
        0x6013,              // 246  str r3, [r2, #0]
        0x4770,              // 248  bx lr
        0x0000,              // 24A  .short 0x0000
        0x3800, 0x4002,      // 24C  .word 0x40023800
        0x3800, 0x4001,      // 250  .word 0x40013800
        0x3C00, 0x4001,      // 254  .word 0x40013c00
    ],
};
