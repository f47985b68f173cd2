//! The Cortex-M4: Unicorn runs the instructions, this module handles the exceptions.
//!
//! Unicorn runs instructions and nothing else: it stacks nothing, knows no priorities and no NVIC.
//! This module enters and leaves exceptions (DDI 0403E section B1.5) and turns what stops Unicorn
//! into an [`Exit`].
//!
//! **Time.** One instruction takes one cycle, or what [`crate::costs`] says if that is asked for,
//! charged when its block (a straight run of code up to a branch) starts; entering an exception takes 12
//! cycles, leaving one 10. Code stops at block borders only, so an interrupt comes at most one block late;
//! SysTick and the cycle counter are read and written at the cycle of the instruction.
//!
//! **What is missing.** Unaligned LDM, STM, LDRD and STRD work instead of faulting unless
//! CCR.UNALIGN_TRP is set; CCR.NONBASETHRDENA is ignored; FPDSCR does not reach a new FPU context;
//! a fault on exception return stacks a frame of its own; the MPU is off;
//! SEV is not seen (WFE ends by itself); an FPU instruction that a false IT condition skips faults
//! all the same while the FPU is off; CCR.BFHFNMIGN is for stores that a register refuses, and an
//! access to where nothing is locks the core up all the same at priority -1.

mod blocks;
mod exceptions;
mod hooks;
mod instruction;

use std::collections::HashSet;

use unicorn_engine::unicorn_const::{uc_error, Arch, Mode, Prot, TlbType};
use unicorn_engine::{ArmCpuModel, RegisterARM, UcHookId, Unicorn};

use crate::chip::memory_map::BOOT_ALIAS;
use crate::chip::Chip;
use crate::cortex::debug::{DFSR_BKPT, DFSR_HALTED};
use crate::cortex::exceptions::{Masks, BUS_FAULT, DEBUG_MONITOR, HARD_FAULT, USAGE_FAULT};
use crate::cortex::scs::{cfsr, hfsr, Traps};
use crate::costs::InstructionCache;
use crate::error::Error;
use crate::memory::{HostMemory, PAGE};
use blocks::{count_instructions, Blocks};

// Unicorn's exception numbers, as its interrupt hook hands them over.
const EXCP_UDEF: u32 = 1;
const EXCP_SWI: u32 = 2;
const EXCP_PREFETCH_ABORT: u32 = 3;
const EXCP_DATA_ABORT: u32 = 4;
const EXCP_BKPT: u32 = 7;
const EXCP_EXCEPTION_EXIT: u32 = 8;
const EXCP_NOCP: u32 = 17;
const EXCP_INVSTATE: u32 = 18;

const XPSR_IT: u32 = 0x0600_FC00;
const XPSR_IT_T_IPSR: u32 = XPSR_IT | XPSR_T | 0x1FF;
const XPSR_T: u32 = 1 << 24;
const CONTROL_NPRIV: u32 = 1 << 0;
const CONTROL_SPSEL: u32 = 1 << 1;
const CONTROL_FPCA: u32 = 1 << 2;
/// Reserved in Armv7-M. Unicorn counts the core as secure, and gives an FPU context a fresh FPSCR as
/// long as this bit is clear.
const CONTROL_SFPA: u32 = 1 << 3;

/// Why translated code stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// The slice is over, or the chip wanted to leave.
    Slice,
    /// WFI was executed.
    WaitForInterrupt,
    /// WFE (or YIELD) was executed.
    WaitForEvent,
    /// SVC was executed.
    SupervisorCall,
    /// An exception return; the value that went to the PC.
    ExceptionReturn(u32),
    /// The program accessed the flash while it was busy.
    FlashBusy,
    /// The next instruction has a breakpoint, or is one.
    Breakpoint,
    /// A fault.
    Fault(Fault),
}

/// A fault before its escalation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A configurable fault: its exception number, its CFSR bits, and the address for BFAR.
    Configurable {
        /// BusFault or UsageFault.
        exception: u16,
        /// Bits of CFSR.
        status: u32,
        /// Address of a precise bus fault.
        address: Option<u32>,
    },
    /// One that goes to HardFault at once: its HFSR bit.
    Hard(u32),
}

impl Fault {
    fn bus(status: u32, address: Option<u32>) -> Self {
        Self::Configurable { exception: BUS_FAULT, status, address }
    }

    fn usage(status: u32) -> Self {
        Self::Configurable { exception: USAGE_FAULT, status, address: None }
    }
}

/// The result of entering an exception.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Entry {
    /// The CPU is in the handler.
    Taken,
    /// The priority is too high for any fault to be taken: lockup (DDI 0403E B1.5.15).
    Lockup,
}

/// An address at which no chip of this emulator has anything: external memory (PM0214 section 2.2).
const NOWHERE: u32 = 0x6000_0000;

/// The state of the CPU at a load of FLASH_SR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Poll {
    /// [`Slice::entries`](crate::slice::Slice::entries).
    entry: u64,
    cycles: u64,
    /// LR, SP, PC and xPSR.
    core: [u32; 4],
    general: [u32; 13],
    /// A checksum of the RAM, once the registers were as before.
    ram: Option<u64>,
    /// How often only the RAM was another one: such a loop counts there.
    counts: u8,
}

/// The data that the hooks leave for the caller.
#[derive(Default)]
struct Notes {
    exception: Option<u32>,
    fault: Option<Fault>,
    flash_busy: bool,
    invalid_instruction: bool,
    /// The masks when the CPU was started, if it was without privilege: they cannot be read then,
    /// nor changed.
    masks: Option<Masks>,
    /// An instruction of the FPU that is switched off lies in the block, at this address.
    fpu_instruction: Option<u32>,
    /// Only one instruction is to run, and breakpoints do not stop it.
    single: bool,
    /// The last load of FLASH_SR, if no other register of a peripheral was accessed since.
    poll: Option<Poll>,
    /// Blocks looked at.
    blocks: Blocks,
    /// What the flash has at hand, where code costs what the manuals say.
    cache: InstructionCache,
    /// Bytes of the block up to the end of the last instruction that accessed a counter of the core.
    located: u32,
    /// Pages of RAM that code was fetched from.
    executed: Vec<bool>,
    /// Pages of flash that code was fetched from.
    flash_executed: Vec<bool>,
    /// The pages that were asked for since the TLB was emptied, and how often one was asked for again.
    asked: HashSet<u32>,
    asked_again: u32,
    /// The pages are asked for by [`Cpu::flush_tlb`].
    balances: bool,
    /// The traps of CCR that `hooks` looks for, and its hook; none without a trap.
    traps: Traps,
    trap_hook: Option<UcHookId>,
    /// The hook of loads from flash; none while nothing depends on them.
    load_hook: Option<UcHookId>,
    /// The instructions from here on to there are those of an IT block, where the engine does not
    /// stop.
    it_block: (u32, u32),
    /// An instruction in an IT block that may trap; the CPU has to stop before it.
    in_doubt: Option<u32>,
    /// The instruction that was in doubt and that the CPU is on its way to.
    on_the_way_to: Option<u32>,
}

/// Hint instructions that end a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hint {
    Yield,
    Wfe,
    Wfi,
}

struct State {
    chip: Chip,
    notes: Notes,
}

/// The CPU with the chip that it runs in.
pub struct Cpu {
    uc: Unicorn<'static, State>,
}

fn failed(doing: &'static str) -> impl Fn(uc_error) -> Error {
    move |error| Error::Engine { doing, error: format!("{error:?}") }
}

impl Cpu {
    /// Builds the CPU around `chip`.
    pub fn new(chip: Chip) -> Result<Self, Error> {
        let pages = |memory: &HostMemory| vec![false; memory.size() / PAGE as usize];
        let notes = Notes {
            executed: pages(&chip.sram),
            flash_executed: pages(&chip.flash.array),
            ..Notes::default()
        };
        let mut uc = Unicorn::new_with_data(Arch::ARM, Mode::THUMB | Mode::MCLASS, State { chip, notes })
            .map_err(failed("starting the CPU emulation"))?;
        uc.ctl_set_cpu_model(ArmCpuModel::CORTEX_M4 as i32).map_err(failed("choosing the CPU"))?;
        uc.ctl_set_tlb_type(TlbType::VIRTUAL).map_err(failed("choosing the TLB"))?;
        uc.ctl_exits_enable().map_err(failed("choosing the exits"))?;
        let mut cpu = Self { uc };
        cpu.map_memories()?;
        cpu.map_registers().map_err(failed("mapping peripherals"))?;
        cpu.add_hooks().map_err(failed("adding the hooks"))?;
        Ok(cpu)
    }

    /// The chip.
    #[must_use]
    pub fn chip(&self) -> &Chip {
        &self.uc.get_data().chip
    }

    /// The chip, to be changed.
    pub fn chip_mut(&mut self) -> &mut Chip {
        &mut self.uc.get_data_mut().chip
    }

    // --- registers
    // ---------------------------------------------------------------------------------------------------

    /// A register of the CPU. The names are Unicorn's own constants, so they are always there.
    #[must_use]
    pub fn register(&self, register: RegisterARM) -> u32 {
        read(&self.uc, register)
    }

    fn set(&mut self, register: RegisterARM, value: u32) {
        let _ = self.uc.reg_write(register, u64::from(value));
    }

    /// r0 to r12, SP, LR, PC, xPSR.
    pub fn core_registers(&mut self) -> [u32; 17] {
        self.privileged(|cpu| {
            std::array::from_fn(|n| match n {
                0..=12 => cpu.uc.reg_read(RegisterARM::R0 as i32 + n as i32).unwrap_or(0) as u32,
                13 => cpu.register(RegisterARM::SP),
                14 => cpu.register(RegisterARM::LR),
                15 => cpu.pc(),
                _ => cpu.register(RegisterARM::XPSR),
            })
        })
    }

    /// Sets one of [`Self::core_registers`]; of xPSR the flags alone.
    pub fn set_core_register(&mut self, number: usize, value: u32) {
        use RegisterARM as R;
        const FLAGS: u32 = 0xF80F_0000;
        match number {
            0..=12 => {
                let _ = self.uc.reg_write(R::R0 as i32 + number as i32, u64::from(value));
            }
            13 => self.privileged(|cpu| cpu.set(R::SP, value & !3)),
            14 => self.set(R::LR, value),
            15 => {
                let thumb = self.register(R::XPSR) >> 24 & 1;
                self.set(R::PC, value & !1 | thumb);
            }
            16 => {
                let xpsr = self.register(R::XPSR);
                self.set(R::XPSR_NZCVQG, xpsr & !FLAGS | value & FLAGS);
            }
            _ => panic!("there is no core register {number}"),
        }
    }

    /// The address of the next instruction.
    #[must_use]
    pub fn pc(&self) -> u32 {
        self.register(RegisterARM::PC)
    }

    /// The mask registers.
    #[must_use]
    pub fn masks(&self) -> Masks {
        masks(&self.uc)
    }

    /// The exception that the CPU is in; 0 in thread mode.
    #[must_use]
    pub fn ipsr(&self) -> u32 {
        self.register(RegisterARM::IPSR) & 0x1FF
    }

    /// Thread mode without privilege hides the stack pointers and masks from Unicorn's accessors.
    /// This runs `act` with privilege.
    fn privileged<R>(&mut self, act: impl FnOnce(&mut Self) -> R) -> R {
        if !self.is_unprivileged() {
            return act(self);
        }
        self.set_ipsr(u32::from(HARD_FAULT));
        let result = act(self);
        self.set_ipsr(0);
        result
    }

    fn is_unprivileged(&self) -> bool {
        self.register(RegisterARM::CONTROL) & CONTROL_NPRIV != 0 && self.ipsr() == 0
    }

    fn set_ipsr(&mut self, number: u32) {
        let xpsr = self.register(RegisterARM::XPSR);
        self.set(RegisterARM::XPSR_NZCVQG, xpsr & !0x1FF | number);
    }

    /// Unicorn keeps a digest of the CPU's mode, which writing IPSR or CONTROL leaves stale;
    /// writing the flags renews it.
    fn renew_mode(&mut self) {
        let flags = self.register(RegisterARM::XPSR) & 0xF000_0000;
        self.set(RegisterARM::APSR_NZCV, flags);
        let ipsr = self.ipsr();
        self.chip_mut().scs.ipsr = u16::try_from(ipsr).unwrap_or(0);
    }

    /// Sets CONTROL, whatever it was before. The CPU is in the handler of exception `handler`
    /// afterwards; 0 is thread mode.
    fn set_mode(&mut self, control: u32, handler: u32) {
        // Only privileged code may write CONTROL, and only in thread mode SPSEL: go to a handler,
        // clear nPRIV, go to thread mode, write CONTROL.
        self.set_ipsr(u32::from(HARD_FAULT));
        self.set(RegisterARM::CONTROL, 0);
        self.set_ipsr(0);
        self.set(RegisterARM::CONTROL, control);
        if handler != 0 {
            self.set_ipsr(handler);
        }
        self.renew_mode();
    }

    /// Reset: SP and PC from the vector table at address 0, everything else as the architecture
    /// says; what it leaves open is 0. A vector that cannot be fetched or run faults as on the
    /// chip.
    pub fn reset(&mut self) {
        use RegisterARM as R;
        self.set_mode(0, 0);
        for register in
            [R::R0, R::R1, R::R2, R::R3, R::R4, R::R5, R::R6, R::R7, R::R8, R::R9, R::R10, R::R11, R::R12]
        {
            self.set(register, 0);
        }
        self.set(R::LR, u32::MAX);
        for register in [R::PRIMASK, R::BASEPRI, R::FAULTMASK, R::FPSCR, R::PSP] {
            self.set(register, 0);
        }
        let table = self.chip_mut().dual_bank_boot().unwrap_or(BOOT_ALIAS);
        let sp = self.peek(table).unwrap_or(0) & !3;
        let entry = self.peek(table + 4).unwrap_or(0);
        self.set(R::MSP, sp);
        self.set(R::XPSR_NZCVQG, if entry & 1 != 0 { XPSR_T } else { 0 });
        self.set(R::PC, entry);
        self.renew_mode();
        let notes = &mut self.uc.get_data_mut().notes;
        *notes = Notes {
            executed: std::mem::take(&mut notes.executed),
            flash_executed: std::mem::take(&mut notes.flash_executed),
            blocks: std::mem::take(&mut notes.blocks),
            traps: notes.traps,
            trap_hook: notes.trap_hook.take(),
            load_hook: notes.load_hook.take(),
            ..Notes::default()
        };
        notes.blocks.clear();
        let chip = self.chip_mut();
        chip.slice.block = (0, 0);
        chip.slice.flush_tlb = true;
    }

    /// Drops every translation and what the translator knows of the memory.
    pub fn forget_translations(&mut self) {
        let notes = &mut self.uc.get_data_mut().notes;
        notes.executed.fill(false);
        notes.flash_executed.fill(false);
        notes.blocks.clear();
        let _ = self.uc.ctl_flush_tb();
        self.flush_tlb();
        self.chip_mut().slice.stale.clear();
        self.chip_mut().slice.flush_tlb = false;
    }

    /// Empties the TLB.
    ///
    /// Unicorn adapts the size of its TLB then, from a count of used entries. It takes an entry off
    /// twice if the page loses its place to another one and is asked for again, as it happens each time
    /// to a peripheral beside RAM at the same offset (flags of such an entry keep the victim TLB from
    /// finding it). Below 0, the count means that the TLB is full, and each flush doubles it, to millions
    /// of entries that each translation goes through. So as many are added here: a page that was there
    /// for loads alone and is asked for a store counts once more.
    fn flush_tlb(&mut self) {
        let notes = &mut self.uc.get_data_mut().notes;
        notes.asked.clear();
        let again = std::mem::take(&mut notes.asked_again);
        notes.balances = true;
        for number in 0..again {
            let kind = if number % 2 == 0 { Prot::READ } else { Prot::WRITE };
            let _ = self.uc.vmem_translate(u64::from(NOWHERE), kind);
        }
        self.uc.get_data_mut().notes.balances = false;
        let _ = self.uc.ctl_flush_tlb();
    }

    // --- memory
    // ------------------------------------------------------------------------------------------------------

    /// Copies memory into `buffer`; whether all of it is memory.
    #[must_use]
    pub fn read_memory(&self, address: u32, buffer: &mut [u8]) -> bool {
        let Some((memory, offset)) = self.chip().memory(address) else { return buffer.is_empty() };
        match memory.bytes().get(offset..offset + buffer.len()) {
            Some(bytes) => {
                buffer.copy_from_slice(bytes);
                true
            }
            None => false,
        }
    }

    fn peek(&self, address: u32) -> Option<u32> {
        let chip = self.chip();
        if chip.flash.is_shut() && chip.is_flash(address) {
            return None;
        }
        let mut word = [0; 4];
        self.read_memory(address, &mut word).then(|| u32::from_le_bytes(word))
    }

    /// Writes into SRAM or CCM; whether all of it lies there. Translations of it are dropped.
    pub fn write_ram(&mut self, address: u32, bytes: &[u8]) -> bool {
        let chip = self.chip_mut();
        let geometry = chip.geometry;
        let Ok(len) = u32::try_from(bytes.len()) else { return false };
        // The CCM holds no code: looking for translations of it would be a fetch from there.
        for (region, memory, holds_code) in
            [(geometry.sram, &mut chip.sram, true), (geometry.ccm, &mut chip.ccm, false)]
        {
            if region.contains(address, len) {
                let at = (address - region.base) as usize;
                memory.bytes_mut()[at..at + bytes.len()].copy_from_slice(bytes);
                if len > 0 && holds_code {
                    chip.slice.stale.push((address, len));
                }
                return true;
            }
        }
        false
    }

    fn poke(&mut self, address: u32, word: u32) -> bool {
        // A stack is no code: no translation needs dropping, or the chip would be as confused.
        let chip = self.chip_mut();
        let geometry = chip.geometry;
        for (region, memory) in [(geometry.sram, &mut chip.sram), (geometry.ccm, &mut chip.ccm)] {
            if region.contains(address, 4) {
                let at = (address - region.base) as usize;
                memory.bytes_mut()[at..at + 4].copy_from_slice(&word.to_le_bytes());
                return true;
            }
        }
        false
    }

    // --- running
    // -----------------------------------------------------------------------------------------------------

    /// Runs translated code until the chip's slice ends or something else happens; `single` asks for
    /// one instruction, wherever breakpoints are.
    pub fn run(&mut self, single: bool) -> Exit {
        self.drop_stale();
        self.set_traps();
        self.watch_loads();
        self.chip_mut().slice.leave = false;
        let masks = self.is_unprivileged().then(|| self.privileged(|cpu| cpu.masks()));
        self.uc.get_data_mut().notes.masks = masks;
        if self.has_breakpoint(self.pc()) {
            return Exit::Breakpoint;
        }
        let exit = if self.steps() {
            self.step()
        } else if single {
            self.one_instruction()
        } else {
            self.enter(None)
        };
        let notes = &mut self.uc.get_data_mut().notes;
        if let Some(address) = notes.in_doubt.take() {
            self.uncharge(self.pc());
            return match self.run_up_to(address) {
                // The next run judges it.
                Exit::WaitForInterrupt if self.pc() == address => Exit::Slice,
                exit => exit,
            };
        }
        let Some(address) = notes.fpu_instruction.take() else { return exit };
        // The FPU is off: run up to its instruction, which faults.
        if address != self.pc() {
            let exit = self.run_up_to(address);
            if exit != Exit::WaitForInterrupt || self.pc() != address {
                return exit;
            }
        }
        Exit::Fault(Fault::usage(cfsr::NOCP))
    }

    /// Runs up to the instruction at `address`, which lies in the block that comes next.
    fn run_up_to(&mut self, address: u32) -> Exit {
        let block = (u64::from(self.pc()), u64::from(address) + 4);
        let _ = self.uc.ctl_remove_cache(block.0, block.1);
        self.chip_mut().slice.leave = false;
        self.uc.get_data_mut().notes.on_the_way_to = Some(address);
        let exit = self.enter(Some(address));
        self.uc.get_data_mut().notes.on_the_way_to = None;
        // The translation that ends there must not stay.
        let _ = self.uc.ctl_remove_cache(block.0, block.1);
        exit
    }

    fn enter(&mut self, until: Option<u32>) -> Exit {
        let chip = self.chip();
        let stops = chip.scs.debug.breakpoints().chain(chip.slice.stops.iter().copied());
        let exits: Vec<u64> = stops.chain(until).map(u64::from).collect();
        if !exits.is_empty() {
            let _ = self.uc.ctl_set_exits(&exits);
        }
        let result = self.start(0);
        if !exits.is_empty() {
            let _ = self.uc.ctl_set_exits(&[]);
        }
        match self.why(result) {
            // It came to a breakpoint, which is seen when it wants to go on.
            Exit::WaitForInterrupt
                if self.is_stop(self.pc()) && self.last_hint(self.pc()) != Some(Hint::Wfi) =>
            {
                Exit::Slice
            }
            exit => exit,
        }
    }

    /// Runs from where the CPU is; so many instructions, or with 0 any number.
    fn start(&mut self, count: usize) -> Result<(), uc_error> {
        let thumb = self.register(RegisterARM::XPSR) & XPSR_T != 0;
        let begin = self.pc() | u32::from(thumb);
        self.chip_mut().slice.entries += 1;
        self.uc.emu_start(u64::from(begin), 0, 0, count)
    }

    /// Whether code stops at this address, by the program's own comparators or by a debugger.
    fn is_stop(&self, address: u32) -> bool {
        self.has_breakpoint(address) || self.chip().slice.stops.contains(&address)
    }

    fn has_breakpoint(&self, address: u32) -> bool {
        self.chip().scs.debug.breakpoints().any(|breakpoint| breakpoint == address)
    }

    /// Whether the DebugMonitor exception follows the next instruction (DDI 0403E C1.5.1).
    fn steps(&mut self) -> bool {
        self.chip().scs.debug.steps() && self.can_monitor()
    }

    /// Whether the DebugMonitor exception can be taken now.
    fn can_monitor(&mut self) -> bool {
        let masks = self.privileged(|cpu| cpu.masks());
        let exceptions = &self.chip().scs.exceptions;
        exceptions.is_enabled(DEBUG_MONITOR)
            && exceptions.group_priority(DEBUG_MONITOR) < exceptions.execution_priority(masks)
    }

    /// Carries out one instruction, which the DebugMonitor exception follows.
    fn step(&mut self) -> Exit {
        let exit = self.one_instruction();
        if matches!(exit, Exit::FlashBusy | Exit::Fault(_)) {
            return exit;
        }
        let chip = self.chip_mut();
        chip.scs.debug.note(DFSR_HALTED);
        chip.scs.exceptions.pend(DEBUG_MONITOR);
        chip.slice.check_exceptions = true;
        match exit {
            Exit::SupervisorCall | Exit::ExceptionReturn(_) | Exit::Breakpoint => exit,
            // A step does not sleep.
            _ => Exit::Slice,
        }
    }

    /// Carries out one instruction.
    fn one_instruction(&mut self) -> Exit {
        let chip = self.chip_mut();
        let (cycles, instructions) = (chip.clock.cycles, chip.counters.instructions);
        chip.slice.block = (0, 0);
        // Blocks that were translated without the counter of instructions would run to their ends.
        let _ = self.uc.ctl_flush_tb();
        self.uc.get_data_mut().notes.single = true;
        let result = self.start(1);
        let exit = self.why(result);
        let _ = self.uc.ctl_flush_tb();
        self.uc.get_data_mut().notes.single = false;
        if matches!(exit, Exit::FlashBusy | Exit::Fault(_)) {
            return exit;
        }
        let chip = self.chip_mut();
        chip.clock.cycles = cycles + 1;
        chip.counters.instructions = instructions + 1;
        match exit {
            // The engine stops after the instruction as it does after WFI.
            Exit::WaitForInterrupt if self.last_hint(self.pc()) != Some(Hint::Wfi) => Exit::Slice,
            exit => exit,
        }
    }

    /// A breakpoint: the DebugMonitor exception if it can be taken, and a HardFault otherwise (DDI
    /// 0403E section C1).
    pub fn breakpoint(&mut self) -> Entry {
        let monitors = self.can_monitor();
        self.chip_mut().scs.debug.note(DFSR_BKPT);
        if !monitors {
            return self.take_fault(Fault::Hard(hfsr::DEBUGEVT));
        }
        self.enter_exception(DEBUG_MONITOR)
    }

    fn drop_stale(&mut self) {
        for (address, len) in std::mem::take(&mut self.chip_mut().slice.stale) {
            if !self.was_executed(address, len) {
                continue;
            }
            if self.chip().swaps_banks() {
                // The code is at another address.
                let _ = self.uc.ctl_flush_tb();
            }
            let _ = self.uc.ctl_remove_cache(u64::from(address), u64::from(address) + u64::from(len));
            self.uc.get_data_mut().notes.blocks.clear();
        }
        if std::mem::take(&mut self.chip_mut().slice.flush_tlb) {
            self.flush_tlb();
        }
        if std::mem::take(&mut self.chip_mut().slice.breakpoints_changed) {
            let _ = self.uc.ctl_flush_tb();
        }
    }

    /// Whether code was fetched from a page of this range; only then can there be translations of
    /// it.
    fn was_executed(&self, address: u32, len: u32) -> bool {
        let State { chip, notes } = self.uc.get_data();
        let geometry = chip.geometry;
        for (region, pages) in [(geometry.flash, &notes.flash_executed), (geometry.sram, &notes.executed)] {
            if region.contains(address, len) {
                let first = (address - region.base) / PAGE;
                let last = (address - region.base + len.max(1) - 1) / PAGE;
                return pages[first as usize..=last as usize].contains(&true);
            }
        }
        true
    }

    fn why(&mut self, result: Result<(), uc_error>) -> Exit {
        let pc = self.pc();
        let notes = &mut self.uc.get_data_mut().notes;
        let exception = notes.exception.take();
        let fault = notes.fault.take();
        let busy = std::mem::take(&mut notes.flash_busy);
        let invalid = std::mem::take(&mut notes.invalid_instruction);
        if busy {
            self.uncharge(pc);
            return Exit::FlashBusy;
        }
        if let Some(fault) = fault {
            self.uncharge(pc);
            return Exit::Fault(fault);
        }
        if invalid {
            return self.invalid(pc);
        }
        match exception {
            Some(EXCP_SWI) => Exit::SupervisorCall,
            Some(EXCP_EXCEPTION_EXIT) => Exit::ExceptionReturn(pc | 1),
            Some(EXCP_BKPT) => Exit::Breakpoint,
            Some(EXCP_DATA_ABORT) => {
                self.uncharge(pc);
                Exit::Fault(Fault::usage(cfsr::UNALIGNED))
            }
            Some(EXCP_PREFETCH_ABORT) => Exit::Fault(Fault::bus(cfsr::IBUSERR, None)),
            Some(EXCP_NOCP) => Exit::Fault(Fault::usage(cfsr::NOCP)),
            Some(EXCP_INVSTATE) => Exit::Fault(Fault::usage(cfsr::INVSTATE)),
            Some(EXCP_UDEF) | Some(_) => Exit::Fault(Fault::usage(cfsr::UNDEFINSTR)),
            None => match result {
                // A write in the block that ends in WFI may have set `leave`.
                Ok(()) if self.chip().slice.leave && !matches!(self.last_hint(pc), Some(Hint::Wfi)) => {
                    Exit::Slice
                }
                Ok(()) => Exit::WaitForInterrupt,
                // Every memory error calls a hook that records a fault; the only other error is an
                // access that the model denies without a hook.
                Err(_) => Exit::Fault(Fault::bus(cfsr::PRECISERR, None)),
            },
        }
    }

    /// The hint instruction that ended the last block, if the PC is right after it.
    fn last_hint(&self, pc: u32) -> Option<Hint> {
        let (start, size) = self.chip().slice.block;
        if size == 0 || pc != start.wrapping_add(size) {
            return None;
        }
        match count_instructions(self.chip(), start, size).last {
            0xBF10 | 0xF3AF_8001 => Some(Hint::Yield),
            0xBF20 | 0xF3AF_8002 => Some(Hint::Wfe),
            0xBF30 | 0xF3AF_8003 => Some(Hint::Wfi),
            _ => None,
        }
    }

    /// Unicorn reports WFE, YIELD, undefined instructions and a clear Thumb bit as the same error.
    fn invalid(&mut self, pc: u32) -> Exit {
        if self.register(RegisterARM::XPSR) & XPSR_T == 0 {
            return Exit::Fault(Fault::usage(cfsr::INVSTATE));
        }
        match self.last_hint(pc) {
            Some(Hint::Wfe) => Exit::WaitForEvent,
            Some(_) => Exit::Slice,
            None => {
                self.uncharge(pc);
                Exit::Fault(Fault::usage(cfsr::UNDEFINSTR))
            }
        }
    }

    /// The cycles of the whole block were counted when it started, but it ended at `pc`: subtracts
    /// the rest.
    fn uncharge(&mut self, pc: u32) {
        let chip = self.chip_mut();
        let (start, size) = chip.slice.block;
        if pc < start || pc >= start.wrapping_add(size) {
            return;
        }
        let rest = count_instructions(chip, pc, start + size - pc);
        chip.clock.cycles = chip.clock.cycles.saturating_sub(rest.cycles);
        chip.counters.instructions = chip.counters.instructions.saturating_sub(rest.instructions);
    }
}

fn read(uc: &Unicorn<'_, State>, register: RegisterARM) -> u32 {
    uc.reg_read(register).unwrap_or(0) as u32
}

fn masks(uc: &Unicorn<'_, State>) -> Masks {
    Masks {
        primask: read(uc, RegisterARM::PRIMASK) & 1 != 0,
        faultmask: read(uc, RegisterARM::FAULTMASK) & 1 != 0,
        basepri: (read(uc, RegisterARM::BASEPRI) & 0xFF) as u8,
    }
}
