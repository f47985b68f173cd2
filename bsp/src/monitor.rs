//! Stops the program at a breakpoint while the bus goes on (feature `monitor`): the DebugMonitor
//! exception of the core (ARM DDI 0403E, section C1).
//!
//! The priority of the exception lies between the priority of the code to be debugged and that of
//! the tasks that serve the bus. While its handler waits, those tasks interrupt it as usual: SDO,
//! heartbeats and the debugger interface itself continue, and so does every task of the application
//! above it. In turn, **code of such a priority, code within a critical section and code that holds
//! a lock of such a task cannot be stopped**. A breakpoint in such code turns all breakpoints off
//! and is reported, and the code continues.
//!
//! The host controls it through the core's own registers, through 1025h:
//!
//! | register | | |
//! |---|---|---|
//! | `FP_CTRL` E0002000h | 3 | breakpoints are on |
//! | `FP_COMP0`–`5` E0002008h… | address, bits 31–30: 1 lower or 2 upper halfword, bit 0 on | a breakpoint |
//! | `DEMCR` E000EDFCh | 01010000h | continue |
//! | | 01050000h | one instruction, then stop again |
//! | | 01030000h | stop now |
//! | | bit 19 (`MON_REQ`) is 1 | the program is stopped |
//! | `DCRDR` E000EDF8h | address of [`Saved`] | while it is stopped: its registers, to be read and changed |

use core::arch::{asm, naked_asm};
use core::sync::atomic::{compiler_fence, AtomicU32, Ordering};

use crate::memory;

const FP_CTRL: u32 = 0xE000_2000;
/// Code comparators 0 to 5; the Cortex-M4 has these six.
const FP_COMP: u32 = 0xE000_2008;
const COMPARATORS: u32 = 6;
const HFSR: u32 = 0xE000_ED2C;
const DFSR: u32 = 0xE000_ED30;
const SHPR3: u32 = 0xE000_ED20;
const DCRDR: u32 = 0xE000_EDF8;
const DEMCR: u32 = 0xE000_EDFC;
/// Writing a bit here makes an interrupt pending.
const ISPR: u32 = 0xE000_E200;

/// `FP_CTRL`: a write without the key is ignored.
const KEY: u32 = 1 << 1;
const ENABLE: u32 = 1 << 0;
const HFSR_DEBUGEVT: u32 = 1 << 31;
const HFSR_FORCED: u32 = 1 << 30;
/// `DFSR`: the cause was a breakpoint; writing 1 clears it.
const BKPT: u32 = 1 << 1;
const DFSR_ALL: u32 = 0x1F;
const MON_EN: u32 = 1 << 16;
const MON_STEP: u32 = 1 << 18;
/// The core does not use this bit; here it means that the program is stopped.
const MON_REQ: u32 = 1 << 19;
const TRCENA: u32 = 1 << 24;

/// Types of a stop, as the emergency reports them (`canopen::debugger::Stop`).
pub const BREAKPOINT: u8 = 1;
/// See [`BREAKPOINT`]: a step is complete, or the host requested the stop.
pub const STEP: u8 = 0x80;
/// See [`BREAKPOINT`]: the breakpoint is in code that cannot be stopped.
pub const OUT_OF_REACH: u8 = 0x81;

/// The registers that the core saves on the stack when it takes an exception.
#[repr(C)]
pub struct Frame {
    /// R0 to R3, R12, LR.
    pub registers: [u32; 6],
    /// The next instruction.
    pub pc: u32,
    /// The flags, and the number of the exception that the program runs in.
    pub xpsr: u32,
}

/// The handler's addition to the frame: `DCRDR` points to this.
#[repr(C)]
pub struct Saved {
    /// Address of the [`Frame`]; the program's SP points right after it.
    pub frame: *mut Frame,
    /// R4 to R11.
    pub registers: [u32; 8],
    /// `EXC_RETURN`.
    pub exc_return: u32,
}

/// A stop that is not yet reported: type (0 for none) and address.
static TYPE: AtomicU32 = AtomicU32::new(0);
static ADDRESS: AtomicU32 = AtomicU32::new(0);
/// The interrupt of the task that reports it.
static TELLER: AtomicU32 = AtomicU32::new(0);

fn load(register: u32) -> u32 {
    // SAFETY: the address is one of the registers above, or of code; reading it changes nothing.
    unsafe { (register as *const u32).read_volatile() }
}

fn store(register: u32, value: u32) {
    // SAFETY: the address is one of the registers above. Their effect on the flow of the program is
    // the purpose of this module.
    unsafe { (register as *mut u32).write_volatile(value) }
}

/// Changes `DEMCR`, which the task for 1025h writes, too.
fn change_demcr(clear: u32, set: u32) {
    let primask: u32;
    // SAFETY: interrupts are off for two accesses, and then restored.
    unsafe {
        asm!("mrs {}, PRIMASK", "cpsid i", out(reg) primask);
        store(DEMCR, load(DEMCR) & !clear | set);
        asm!("msr PRIMASK, {}", in(reg) primask);
    }
}

/// Enables breakpoints, of which there are none yet, unless the chip's read-out protection is on.
/// `priority` is the exception's in the core's encoding (the upper four bits): more urgent (a lower
/// value) than that of the code to be stopped, and less urgent than that of the tasks that serve
/// the bus. A stop makes the interrupt with the number `interrupt` pending; its task reports the
/// stop by [`take_stop`].
pub fn arm(priority: u8, interrupt: u16) {
    if memory::is_locked() {
        return;
    }
    TELLER.store(interrupt.into(), Ordering::Relaxed);
    store(FP_CTRL, KEY);
    for n in 0..COMPARATORS {
        store(FP_COMP + 4 * n, 0);
    }
    store(DFSR, DFSR_ALL);
    store(SHPR3, load(SHPR3) & !0xFF | u32::from(priority));
    store(DEMCR, TRCENA | MON_EN);
}

/// The type and the address of a stop that is not yet reported; each stop is returned once.
pub fn take_stop() -> Option<(u8, u32)> {
    let kind = TYPE.load(Ordering::Acquire);
    if kind == 0 {
        return None;
    }
    TYPE.store(0, Ordering::Relaxed);
    Some((kind as u8, ADDRESS.load(Ordering::Relaxed)))
}

/// Continues a stopped program, and disables breakpoints.
pub fn release_program() {
    store(FP_CTRL, KEY);
    change_demcr(MON_EN | MON_STEP | MON_REQ, 0);
}

fn notify(kind: u8, address: u32) {
    ADDRESS.store(address, Ordering::Relaxed);
    TYPE.store(kind.into(), Ordering::Release);
    pend_teller();
}

fn pend_teller() {
    let interrupt = TELLER.load(Ordering::Relaxed);
    store(ISPR + 4 * (interrupt / 32), 1 << (interrupt % 32));
}

/// The exception's entry: it completes the core's frame to [`Saved`], and restores from there.
///
/// # Safety
/// Only the core may call it.
#[allow(non_snake_case)]
#[unsafe(no_mangle)]
#[unsafe(naked)]
pub unsafe extern "C" fn DebugMonitor() {
    naked_asm!(
        "tst lr, #4",
        "ite eq",
        "mrseq r0, MSP",
        "mrsne r0, PSP",
        // It pushes ten words: the stack stays aligned to 8 bytes.
        "push {{r0, r4-r11, lr}}",
        "mov r0, sp",
        "bl {handler}",
        "pop {{r0, r4-r11, pc}}",
        handler = sym on_debug_event,
    )
}

/// The entry of a fault. A fault that was caused by a breakpoint in code that cannot be stopped is
/// ignored; any other fault restarts the device.
///
/// # Safety
/// Only the core may call it.
#[allow(non_snake_case)]
#[unsafe(no_mangle)]
#[unsafe(naked)]
pub unsafe extern "C" fn HardFault() {
    naked_asm!(
        "tst lr, #4",
        "ite eq",
        "mrseq r0, MSP",
        "mrsne r0, PSP",
        "push {{r4, lr}}",
        "bl {handler}",
        "pop {{r4, pc}}",
        handler = sym on_fault,
    )
}

unsafe extern "C" fn on_fault(frame: *const Frame) {
    const AIRCR: u32 = 0xE000_ED0C;
    const SYSTEM_RESET: u32 = 0x05FA_0004;
    let by_breakpoint = load(HFSR) & HFSR_DEBUGEVT != 0 && load(FP_CTRL) & ENABLE != 0;
    if !by_breakpoint {
        store(AIRCR, SYSTEM_RESET);
        loop {
            compiler_fence(Ordering::SeqCst);
        }
    }
    store(FP_CTRL, KEY);
    store(HFSR, HFSR_DEBUGEVT | HFSR_FORCED);
    store(DFSR, DFSR_ALL);
    // SAFETY: a debug event does not come from a broken stack; the entry passes the frame on it.
    notify(OUT_OF_REACH, unsafe { (*frame).pc });
    synchronize();
}

unsafe extern "C" fn on_debug_event(saved: *mut Saved) {
    // SAFETY: the entry has just built it on the stack, and the core has built the frame; both stay
    // there until this function returns. The host may change both through 1025h while this function
    // waits, so they are read and written by volatile accesses.
    let pc = unsafe { &raw mut (*(&raw const (*saved).frame).read_volatile()).pc };
    let cause = load(DFSR);
    store(DFSR, DFSR_ALL);
    if let Some(step) = Step::take() {
        step.end();
        if !step.asked && cause & BKPT == 0 {
            synchronize();
            return;
        }
    }
    // SAFETY: see above.
    let stopped_at = unsafe { pc.read_volatile() };
    change_demcr(MON_STEP, MON_REQ);
    store(DCRDR, saved as u32);
    notify(if cause & BKPT != 0 { BREAKPOINT } else { STEP }, stopped_at);
    while load(DEMCR) & MON_REQ != 0 {
        // The tasks that serve the bus must check their deadlines. The code that wakes them
        // otherwise may be the stopped code.
        pend_teller();
        // SAFETY: it waits for an interrupt; the pended interrupt has run before.
        unsafe { asm!("dsb", "isb", "wfi") };
    }
    // SAFETY: see above.
    let next = unsafe { pc.read_volatile() };
    let instruction = Instruction::at(next);
    if next == stopped_at && instruction == Instruction::Breakpoint {
        // The breakpoint is an instruction of the code itself: the program continues after it.
        // SAFETY: see above.
        unsafe { pc.write_volatile(next + 2) };
    } else {
        let asked = load(DEMCR) & MON_STEP != 0;
        let over = load(FP_CTRL) & ENABLE != 0 && has_breakpoint(next);
        if asked || over {
            Step { asked, over, mask: None }.begin(instruction);
        }
    }
    synchronize();
}

/// The execution of one single instruction.
#[derive(Clone, Copy)]
struct Step {
    /// The host requested the step, and gets a report at its end.
    asked: bool,
    /// There is a breakpoint at the instruction: meanwhile all breakpoints are off.
    over: bool,
    /// The previous mask (BASEPRI), if the step changed it.
    mask: Option<u8>,
}

/// The state of the step: the bits [`STEPS`], asked, over, changed the mask; the mask from bit 8
/// on.
static STEP_STATE: AtomicU32 = AtomicU32::new(0);
const STEPS: u32 = 1 << 0;
const ASKED: u32 = 1 << 1;
const OVER: u32 = 1 << 2;
const MASKED: u32 = 1 << 3;

impl Step {
    fn take() -> Option<Self> {
        let state = STEP_STATE.load(Ordering::Relaxed);
        STEP_STATE.store(0, Ordering::Relaxed);
        let mask = (state & MASKED != 0).then_some((state >> 8) as u8);
        (state & STEPS != 0).then_some(Self { asked: state & ASKED != 0, over: state & OVER != 0, mask })
    }

    fn begin(mut self, instruction: Instruction) {
        // No other code that can be stopped may run in between: that code would be stopped instead.
        // An instruction that changes the mask itself runs without the mask.
        let in_force = basepri();
        let least = (load(SHPR3) as u8).saturating_add(PRIORITY_STEP);
        if instruction != Instruction::SetsMask && (in_force == 0 || in_force > least) {
            self.mask = Some(in_force);
            set_basepri(least);
        }
        if self.over {
            store(FP_CTRL, KEY);
        }
        let flag = |on, bit| if on { bit } else { 0 };
        let mask = self.mask.map_or(0, |mask| MASKED | u32::from(mask) << 8);
        STEP_STATE.store(STEPS | flag(self.asked, ASKED) | flag(self.over, OVER) | mask, Ordering::Relaxed);
        change_demcr(0, MON_STEP);
    }

    fn end(self) {
        change_demcr(MON_STEP, 0);
        if let Some(mask) = self.mask {
            set_basepri(mask);
        }
        if self.over {
            store(FP_CTRL, KEY | ENABLE);
        }
    }
}

/// Difference between two priorities: the chip has the upper four bits.
const PRIORITY_STEP: u8 = 0x10;

/// The kind of the instruction at a stop.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Instruction {
    Breakpoint,
    SetsMask,
    Other,
}

impl Instruction {
    fn at(pc: u32) -> Self {
        let mut code = [0; 4];
        if memory::read(pc, &mut code).is_err() {
            return Self::Other;
        }
        let [a, b, c, d] = code;
        match (u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d])) {
            // BKPT (DDI 0403E section A7.7).
            (0xBE00..=0xBEFF, _) => Self::Breakpoint,
            // MSR to BASEPRI or BASEPRI_MAX (section B5.2).
            (0xF380..=0xF38F, 0x8811 | 0x8812) => Self::SetsMask,
            _ => Self::Other,
        }
    }
}

/// Whether a comparator stops at this address (DDI 0403E section C1.11).
fn has_breakpoint(pc: u32) -> bool {
    let half = if pc & 2 == 0 { 0b01 } else { 0b10 };
    (0..COMPARATORS).map(|n| load(FP_COMP + 4 * n)).any(|comparator| {
        let replace = comparator >> 30;
        comparator & ENABLE != 0 && comparator & 0x1FFF_FFFC == pc & !3 && replace & half != 0
    })
}

fn basepri() -> u8 {
    let value: u32;
    // SAFETY: it only reads the register.
    unsafe { asm!("mrs {}, BASEPRI", out(reg) value) };
    value as u8
}

fn set_basepri(value: u8) {
    // SAFETY: the handler's own priority is above every mask that is set here: the masked code must
    // wait for the handler anyway.
    unsafe { asm!("msr BASEPRI, {}", in(reg) u32::from(value)) };
}

/// Makes register writes take effect before the next instruction of the program.
fn synchronize() {
    // SAFETY: these are barriers.
    unsafe { asm!("dsb", "isb") };
}
