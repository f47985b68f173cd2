//! The Cortex-M4: Unicorn runs the instructions, this module handles the exceptions.
//!
//! Unicorn runs instructions and nothing else: it stacks nothing, knows no priorities and no NVIC.
//! This module enters and leaves exceptions (DDI 0403E section B1.5) and turns what stops Unicorn
//! into an [`Exit`].
//!
//! **Time.** One instruction takes one cycle, or what [`costs`] says if that is asked for,
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

mod accesses;
mod traps;

use std::collections::{HashMap, HashSet};

use shared_abi::geometry::SYSTEM_MEMORY;
use unicorn_engine::unicorn_const::{uc_error, Arch, HookType, MemType, Mode, Prot, TlbEntry, TlbType};
use unicorn_engine::{ArmCpuModel, RegisterARM, UcHookId, Unicorn};

use crate::chip::{
    counts_cycles, Chip, BOOT_ALIAS, HIDDEN, OPTION_PAGE, OTP, PATCHED, PERIPHERALS, PERIPHERALS_AHB2,
    PERIPHERAL_ALIAS, PRIVATE, SRAM_ALIAS, SYSTEM,
};
use crate::cortex::debug::{DFSR_BKPT, DFSR_HALTED};
use crate::cortex::exceptions::{
    Masks, BUS_FAULT, DEBUG_MONITOR, HARD_FAULT, MEM_MANAGE, NMI, SV_CALL, USAGE_FAULT,
};
use crate::cortex::scs::{cfsr, hfsr, RefusedStore, Traps};
use crate::costs::{self, InstructionCache};
use crate::error::Error;
use crate::memory::{HostMemory, PAGE};
use crate::report::Access;
use crate::time::Time;
use traps::Instruction;

/// Cycles from recognition of an exception to its first instruction (PM0214 section 2.3.7).
const ENTRY_CYCLES: u64 = 12;
/// Cycles of an exception return.
const RETURN_CYCLES: u64 = 10;

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
const XPSR_ALIGNED: u32 = 1 << 9;
const CONTROL_NPRIV: u32 = 1 << 0;
const CONTROL_SPSEL: u32 = 1 << 1;
const CONTROL_FPCA: u32 = 1 << 2;
/// Reserved in Armv7-M. Unicorn counts the core as secure, and gives an FPU context a fresh FPSCR as
/// long as this bit is clear.
const CONTROL_SFPA: u32 = 1 << 3;

/// Words of the basic and of the extended stack frame.
const BASIC_FRAME: u32 = 8;
const EXTENDED_FRAME: u32 = 26;

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
    /// The traps of CCR that [`on_instruction`] looks for, and its hook; none without a trap.
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
        cpu.add_hooks().map_err(failed("adding the hooks"))?;
        Ok(cpu)
    }

    fn map_memories(&mut self) -> Result<(), Error> {
        let state = self.uc.get_data();
        let (sram_base, sram_size) = (state.chip.geometry.sram.base, state.chip.geometry.sram.size);
        let ccm_base = state.chip.geometry.ccm.base;
        let flash_base = state.chip.geometry.flash.base;
        let pointer = |memory: &HostMemory| (memory.as_ptr(), memory.size() as u64);
        let chip = &state.chip;
        let blocks = [
            (flash_base, pointer(&chip.flash.array), Prot::READ | Prot::EXEC),
            (sram_base, pointer(&chip.sram), Prot::ALL),
            (ccm_base, pointer(&chip.ccm), Prot::READ | Prot::WRITE),
            (SYSTEM.base, pointer(&chip.system), Prot::READ | Prot::EXEC),
            (OPTION_PAGE.base, pointer(&chip.options), Prot::READ),
            (PATCHED.base, pointer(&chip.patched), Prot::READ | Prot::EXEC),
        ];
        let with_ccm = chip.geometry.ccm.size > 0;
        for (base, (memory, len), perms) in blocks {
            if base == ccm_base && !with_ccm {
                continue;
            }
            // SAFETY: the memory belongs to the chip, which the engine's data owns: the engine is
            // closed before its data is dropped. Its length is a multiple of the page size
            // (`HostMemory::new`).
            unsafe { self.uc.mem_map_ptr(base.into(), len, perms, memory.cast()) }
                .map_err(failed("mapping memory"))?;
            // Mapping alone would let stores through to read-only memory without the hook.
            self.uc.mem_protect(base.into(), len, perms).map_err(failed("protecting memory"))?;
        }
        for region in [PERIPHERALS, PERIPHERALS_AHB2, PERIPHERAL_ALIAS, PRIVATE] {
            let base = region.base;
            self.uc
                .mmio_map(
                    u64::from(base),
                    u64::from(region.size.next_multiple_of(PAGE)),
                    Some(move |uc: &mut Unicorn<'_, State>, offset: u64, size: usize| {
                        let address = base + offset as u32;
                        note_moment(uc, Access::Read, address);
                        let value = uc.get_data_mut().chip.load(address, size as u8);
                        locate_reports(uc);
                        u64::from(value)
                    }),
                    Some(move |uc: &mut Unicorn<'_, State>, offset: u64, size: usize, value: u64| {
                        let address = base + offset as u32;
                        note_moment(uc, Access::Write, address);
                        uc.get_data_mut().chip.store(address, size as u8, value as u32);
                        settle_bus_error(uc);
                        locate_reports(uc);
                    }),
                )
                .map_err(failed("mapping peripherals"))?;
        }
        self.uc
            .mmio_map(
                HIDDEN.base.into(),
                HIDDEN.size.into(),
                Some(|uc: &mut Unicorn<'_, State>, _: u64, _: usize| {
                    uc.get_data_mut().chip.flash.load_hidden();
                    0
                }),
                None::<fn(&mut Unicorn<'_, State>, u64, usize, u64)>,
            )
            .map_err(failed("mapping what is hidden"))?;
        self.uc
            .mmio_map(
                SRAM_ALIAS.into(),
                u64::from(sram_size) * 32,
                Some(|uc: &mut Unicorn<'_, State>, offset: u64, _size: usize| {
                    let chip = &uc.get_data().chip;
                    chip.sram_bit(SRAM_ALIAS + offset as u32)
                        .map_or(0, |(byte, bit)| u64::from(chip.sram.bytes()[byte] >> bit & 1))
                }),
                Some(move |uc: &mut Unicorn<'_, State>, offset: u64, _size: usize, value: u64| {
                    let chip = &mut uc.get_data_mut().chip;
                    if let Some((byte, bit)) = chip.sram_bit(SRAM_ALIAS + offset as u32) {
                        let cell = &mut chip.sram.bytes_mut()[byte];
                        *cell = *cell & !(1 << bit) | (value as u8 & 1) << bit;
                    }
                }),
            )
            .map_err(failed("mapping the bit-band alias"))?;
        Ok(())
    }

    fn add_hooks(&mut self) -> Result<(), uc_error> {
        let geometry = self.uc.get_data().chip.geometry;
        self.uc.add_block_hook(1, 0, |uc, address, size| on_block(uc, address as u32, size))?;
        self.uc.add_tlb_hook(1, 0, |uc, address, kind| {
            let entry = on_tlb_miss(uc, address as u32, kind);
            if entry.is_some() && kind != MemType::FETCH {
                forget_it_state(uc);
            }
            entry
        })?;
        self.uc.add_intr_hook(|uc, number| {
            uc.get_data_mut().notes.exception = Some(number);
            let _ = uc.emu_stop();
        })?;
        self.uc.add_insn_invalid_hook(|uc| {
            uc.get_data_mut().notes.invalid_instruction = true;
            false
        })?;
        // A hook over an address keeps the translator from storing straight into its page, so RAM
        // is left out.
        let ram = geometry.sram;
        for (begin, end) in [(0, ram.base - 1), (ram.end(), u32::MAX)] {
            self.uc.add_mem_hook(
                HookType::MEM_READ_UNMAPPED | HookType::MEM_WRITE_UNMAPPED,
                begin.into(),
                end.into(),
                |uc, kind, address, size, value| on_unmapped(uc, kind, address as u32, size, value as u32),
            )?;
        }
        for region in [geometry.flash, SYSTEM, OPTION_PAGE] {
            self.uc.add_mem_hook(
                HookType::MEM_WRITE_PROT,
                region.base.into(),
                u64::from(region.end() - 1),
                |uc, _, address, size, value| on_protected_write(uc, address as u32, size, value as u64),
            )?;
        }
        Ok(())
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

    /// The memory block of `address`, with the offset in it. Only plain memory, no peripherals.
    fn memory(chip: &Chip, address: u32) -> Option<(&HostMemory, usize)> {
        let geometry = chip.geometry;
        let address = chip.behind_alias(address).unwrap_or(address);
        for (region, memory) in [
            (geometry.sram, &chip.sram),
            (geometry.flash, &chip.flash.array),
            (geometry.ccm, &chip.ccm),
            (SYSTEM, &chip.system),
            (OPTION_PAGE, &chip.options),
        ] {
            if region.contains(address, 1) {
                return Some((memory, (address - region.base) as usize));
            }
        }
        None
    }

    /// Copies memory into `buffer`; whether all of it is memory.
    #[must_use]
    pub fn read_memory(&self, address: u32, buffer: &mut [u8]) -> bool {
        let Some((memory, offset)) = Self::memory(self.chip(), address) else { return buffer.is_empty() };
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
        if chip.flash.is_shut() && is_flash(chip, address) {
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

    /// Has every instruction looked at while a trap of CCR is set, and none otherwise: it costs
    /// time.
    fn set_traps(&mut self) {
        let State { chip, notes } = self.uc.get_data_mut();
        let traps = chip.scs.traps();
        if traps == notes.traps {
            return;
        }
        notes.traps = traps;
        if traps.any() == notes.trap_hook.is_some() {
            return;
        }
        match notes.trap_hook.take() {
            Some(hook) => {
                let _ = self.uc.remove_hook(hook);
            }
            None => {
                let hook = self.uc.add_code_hook(1, 0, |uc, address, _| on_instruction(uc, address as u32));
                self.uc.get_data_mut().notes.trap_hook = hook.ok();
            }
        }
        let _ = self.uc.ctl_flush_tb();
    }

    /// Has every load from flash noticed while the data cache is in the way, and none otherwise: it costs time.
    /// The loads in the rest of the block that switches the cache on are not noticed.
    fn watch_loads(&mut self) {
        let State { chip, notes } = self.uc.get_data_mut();
        let flash = chip.geometry.flash;
        if chip.flash.caches_data() == notes.load_hook.is_some() {
            return;
        }
        match notes.load_hook.take() {
            Some(hook) => {
                let _ = self.uc.remove_hook(hook);
            }
            None => {
                let (first, last) = (u64::from(flash.base), u64::from(flash.end() - 1));
                let hook =
                    self.uc.add_mem_hook(HookType::MEM_READ, first, last, |uc, _, address, size, _| {
                        uc.get_data_mut().chip.load_flash(address as u32, size as u32);
                        forget_it_state(uc);
                        true
                    });
                self.uc.get_data_mut().notes.load_hook = hook.ok();
            }
        }
        // Loads that are translated already do not look for hooks.
        let _ = self.uc.ctl_flush_tb();
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

    // --- exceptions
    // --------------------------------------------------------------------------------------------------

    /// The exception that is to be taken now.
    #[must_use]
    pub fn deliverable(&mut self) -> Option<u16> {
        if !self.chip().slice.check_exceptions {
            return None;
        }
        let masks = self.privileged(|cpu| cpu.masks());
        self.chip().scs.exceptions.deliverable(masks)
    }

    /// Whether WFI ends.
    #[must_use]
    pub fn wakes(&mut self) -> bool {
        let masks = self.privileged(|cpu| cpu.masks());
        self.chip().scs.exceptions.wakes(masks)
    }

    /// Where the vector of `exception` is.
    #[must_use]
    pub fn vector_address(&self, exception: u16) -> u32 {
        self.chip().scs.vtor.wrapping_add(4 * u32::from(exception))
    }

    /// Enters `exception` (DDI 0403E B1.5.6), or what comes before it if that faults.
    pub fn enter_exception(&mut self, exception: u16) -> Entry {
        use RegisterARM as R;
        let thread = self.ipsr() == 0;
        let control = self.register(R::CONTROL);
        let on_psp = thread && control & CONTROL_SPSEL != 0;
        let floating = control & CONTROL_FPCA != 0;
        let words = if floating { EXTENDED_FRAME } else { BASIC_FRAME };
        let sp = self.register(R::SP);
        let aligns = self.chip().scs.aligns_stack() || floating;
        let padding = aligns && sp & 4 != 0;
        let frame = sp.wrapping_sub(4 * words).wrapping_sub(if padding { 4 } else { 0 });
        let xpsr = self.register(R::XPSR) & !XPSR_ALIGNED | if padding { XPSR_ALIGNED } else { 0 };
        let mut contents = vec![
            self.register(R::R0),
            self.register(R::R1),
            self.register(R::R2),
            self.register(R::R3),
            self.register(R::R12),
            self.register(R::LR),
            self.pc(),
            xpsr,
        ];
        if floating {
            contents.extend((0..16).map(|n| self.single(n)));
            contents.extend([self.register(R::FPSCR), 0]);
        }
        let stacked = contents
            .iter()
            .enumerate()
            .fold(true, |ok, (n, word)| self.poke(frame.wrapping_add(4 * n as u32), *word) && ok);
        let exception = if stacked { exception } else { self.stacking_failed(exception) };
        let Some((exception, handler)) = self.vector_of(exception) else { return Entry::Lockup };
        self.set(R::SP, frame);
        let return_to = match (thread, on_psp) {
            (false, _) => 0xFFFF_FFF1,
            (true, false) => 0xFFFF_FFF9,
            (true, true) => 0xFFFF_FFFD,
        } & if floating { !0x10_u32 } else { !0 };
        if control & (CONTROL_SPSEL | CONTROL_FPCA) != 0 {
            self.set_mode(control & CONTROL_NPRIV, u32::from(exception));
        }
        self.set(R::LR, return_to);
        let flags = self.register(R::XPSR) & !XPSR_IT_T_IPSR;
        let thumb = if handler & 1 != 0 { XPSR_T } else { 0 };
        self.set(R::XPSR_NZCVQG, flags | thumb | u32::from(exception));
        self.set(R::PC, handler);
        self.renew_mode();
        let chip = self.chip_mut();
        chip.scs.exceptions.enter(exception);
        chip.slice.check_exceptions = chip.scs.exceptions.any_pending();
        chip.clock.cycles += ENTRY_CYCLES;
        if let Some(count) = chip.counters.exceptions.get_mut(usize::from(exception)) {
            *count += 1;
        }
        Entry::Taken
    }

    /// The frame of `original` could not be written: that is a BusFault, which becomes pending
    /// beside it. Returns the one of the two that comes first; the stack pointer moves as if the
    /// frame were there (DDI 0403E B1.5.11, derived exceptions).
    fn stacking_failed(&mut self, original: u16) -> u16 {
        let masks = self.privileged(|cpu| cpu.masks());
        let scs = &mut self.chip_mut().scs;
        scs.cfsr |= cfsr::STKERR;
        let preempted = scs.exceptions.execution_priority(masks);
        scs.exceptions.pend(original);
        if scs.exceptions.is_enabled(BUS_FAULT) && scs.exceptions.group_priority(BUS_FAULT) < preempted {
            scs.exceptions.pend(BUS_FAULT);
        } else if preempted > -1 {
            scs.hfsr |= hfsr::FORCED;
            scs.exceptions.pend(HARD_FAULT);
        }
        scs.exceptions.first_pending().map_or(original, |(first, _)| first)
    }

    /// The vector of `exception`, or of the HardFault if it cannot be fetched, and whose it is; the
    /// exception is pending then. `None` is lockup: NMI and HardFault have nothing above them.
    fn vector_of(&mut self, exception: u16) -> Option<(u16, u32)> {
        if let Some(handler) = self.peek(self.vector_address(exception)) {
            return Some((exception, handler));
        }
        if matches!(exception, HARD_FAULT | NMI) {
            return None;
        }
        let scs = &mut self.chip_mut().scs;
        scs.hfsr |= hfsr::VECTTBL;
        scs.exceptions.pend(exception);
        Some((HARD_FAULT, self.peek(self.vector_address(HARD_FAULT))?))
    }

    /// Leaves the present exception by `value` (DDI 0403E B1.5.8); the fault that a bad value or
    /// stack leads to.
    pub fn return_from_exception(&mut self, value: u32) -> Result<(), Fault> {
        use RegisterARM as R;
        let leaving = u16::try_from(self.ipsr()).unwrap_or(0);
        let (handler, on_psp) = match value & 0xF {
            0x1 => (true, false),
            0x9 => (false, false),
            0xD => (false, true),
            _ => return Err(Fault::usage(cfsr::INVPC)),
        };
        if value | 0x1F != u32::MAX || !self.chip().scs.exceptions.is_active(leaving) {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let nested = self.chip().scs.exceptions.active_count() > 1;
        if handler != nested {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let floating = value & 0x10 == 0;
        let words = if floating { EXTENDED_FRAME } else { BASIC_FRAME };
        let frame = if on_psp { self.register(R::PSP) } else { self.register(R::MSP) };
        let mut contents = Vec::new();
        for n in 0..words {
            match self.peek(frame.wrapping_add(4 * n)) {
                Some(word) => contents.push(word),
                None => return Err(Fault::bus(cfsr::UNSTKERR, None)),
            }
        }
        let xpsr = contents[7];
        let back_to = xpsr & 0x1FF;
        if handler == (back_to == 0) {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let npriv = self.register(R::CONTROL) & CONTROL_NPRIV;
        if leaving != NMI {
            self.set(R::FAULTMASK, 0);
        }
        let sp = frame.wrapping_add(4 * words) + if xpsr & XPSR_ALIGNED != 0 { 4 } else { 0 };
        self.set(if on_psp { R::PSP } else { R::MSP }, sp);
        for (register, word) in [R::R0, R::R1, R::R2, R::R3, R::R12, R::LR].into_iter().zip(&contents) {
            self.set(register, *word);
        }
        if floating {
            for (n, word) in (0..16).zip(&contents[8..24]) {
                self.set_single(n, *word);
            }
            self.set(R::FPSCR, contents[24]);
        }
        let control = npriv
            | if on_psp { CONTROL_SPSEL } else { 0 }
            | if floating { CONTROL_FPCA | CONTROL_SFPA } else { 0 };
        if handler && control & !CONTROL_NPRIV == 0 {
            self.set_ipsr(back_to);
        } else {
            // In thread mode SPSEL comes from the value; in a handler it is 0.
            let control = if handler { control & !CONTROL_SPSEL } else { control };
            self.set_mode(control, back_to);
        }
        self.set(R::XPSR_NZCVQG, xpsr & !XPSR_ALIGNED);
        self.set(R::PC, contents[6] & !1 | xpsr >> 24 & 1);
        self.renew_mode();
        let chip = self.chip_mut();
        chip.scs.exceptions.leave(leaving);
        chip.slice.check_exceptions = chip.scs.exceptions.any_pending();
        chip.clock.cycles += RETURN_CYCLES;
        Ok(())
    }

    fn single_register(n: i32) -> i32 {
        RegisterARM::S0 as i32 + n
    }

    fn single(&self, n: i32) -> u32 {
        self.uc.reg_read(Self::single_register(n)).unwrap_or(0) as u32
    }

    fn set_single(&mut self, n: i32, value: u32) {
        let _ = self.uc.reg_write(Self::single_register(n), u64::from(value));
    }

    /// Takes a fault: at its own priority if it is enabled and high enough, as HardFault otherwise
    /// (DDI 0403E B1.5.10).
    pub fn take_fault(&mut self, fault: Fault) -> Entry {
        let masks = self.privileged(|cpu| cpu.masks());
        let scs = &mut self.chip_mut().scs;
        let current = scs.exceptions.execution_priority(masks);
        let exception = match fault {
            Fault::Configurable { exception, status, address } => {
                scs.cfsr |= status;
                if let Some(address) = address {
                    scs.bfar = address;
                    scs.cfsr |= cfsr::BFARVALID;
                }
                let taken = scs.exceptions.is_enabled(exception)
                    && scs.exceptions.group_priority(exception) < current;
                if taken {
                    exception
                } else {
                    scs.hfsr |= hfsr::FORCED;
                    HARD_FAULT
                }
            }
            Fault::Hard(status) => {
                scs.hfsr |= status;
                HARD_FAULT
            }
        };
        if exception == HARD_FAULT && current <= -1 {
            return Entry::Lockup;
        }
        self.enter_exception(exception)
    }

    /// Carries out SVC: the call is taken if its priority allows, and is a HardFault otherwise.
    pub fn supervisor_call(&mut self) -> Entry {
        let masks = self.privileged(|cpu| cpu.masks());
        let exceptions = &self.chip().scs.exceptions;
        if exceptions.group_priority(SV_CALL) < exceptions.execution_priority(masks) {
            self.enter_exception(SV_CALL)
        } else {
            self.take_fault(Fault::Hard(hfsr::FORCED))
        }
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

// The hooks of loads and stores never stop the engine themselves: it would put the PC back to the
// instruction, which then runs twice. They set `Slice::leave`, and the next block does not start. The
// exception is a store with a precise fault, to which the PC has to point.

/// After a store to a peripheral: a bus error becomes a fault, or is ignored.
fn settle_bus_error(uc: &mut Unicorn<'_, State>) {
    let Some(address) = uc.get_data_mut().chip.slice.bus_error.take() else { return };
    let masks = uc.get_data().notes.masks.unwrap_or_else(|| masks(uc));
    let State { chip, notes } = uc.get_data_mut();
    chip.slice.leave = true;
    match chip.scs.refuse_store(address, masks) {
        RefusedStore::Pended => chip.slice.check_exceptions = true,
        // The program asks to have the fault ignored: nothing to report.
        RefusedStore::Ignored => drop(chip.slice.unlocated.pop()),
        RefusedStore::Taken => {
            notes.fault = Some(Fault::bus(cfsr::PRECISERR, Some(address)));
            let _ = uc.emu_stop();
        }
    }
}

/// Finds the instruction of each access to a peripheral that is to be reported.
fn locate_reports(uc: &mut Unicorn<'_, State>) {
    while let Some(mut report) = uc.get_data_mut().chip.slice.unlocated.pop() {
        let offset = locate(uc, 0, report.access, report.address).unwrap_or(0);
        let chip = &mut uc.get_data_mut().chip;
        report.pc = chip.slice.block.0.wrapping_add(offset);
        chip.reports.add(report);
    }
}

/// The instruction of the block, from this one on, that makes an access: its offset in the block.
fn locate(uc: &Unicorn<'_, State>, from: u32, access: Access, address: u32) -> Option<u32> {
    let chip = &uc.get_data().chip;
    let (start, size) = chip.slice.block;
    let (memory, offset) = Cpu::memory(chip, start)?;
    let code = memory.bytes().get(offset + from as usize..offset + size as usize)?;
    let registers = std::array::from_fn(|n| base_register(uc, n as u32));
    accesses::find(code, &registers, access, address).map(|offset| from + offset)
}

/// The program accesses a register. If it belongs to a counter of the core, the chip has to know the cycle.
/// An instruction that is not found counts as the last one that was, so that time never goes back.
fn note_moment(uc: &mut Unicorn<'_, State>, access: Access, address: u32) {
    let State { chip, notes } = uc.get_data_mut();
    chip.slice.ahead = 0;
    // The cycle of a single instruction is counted after it.
    if !counts_cycles(address) || notes.single {
        return;
    }
    let ((start, size), from) = (chip.slice.block, notes.located);
    let key = (start, size, from, access, address);
    if let Some(&(located, ahead)) = notes.blocks.moments.get(&key) {
        notes.located = located;
        chip.slice.ahead = ahead;
        return;
    }
    let found = locate(uc, from, access, address)
        .and_then(|offset| Some(offset + instruction(&uc.get_data().chip, start + offset)?.len()));
    let State { chip, notes } = uc.get_data_mut();
    let located = found.unwrap_or(from).min(size);
    let ahead = count_instructions(chip, start + located, size - located).cycles;
    notes.located = located;
    notes.blocks.moments.insert(key, (located, ahead));
    chip.slice.ahead = ahead;
}

// --- hooks
// -----------------------------------------------------------------------------------------------------------

fn stop(uc: &mut Unicorn<'_, State>) {
    uc.get_data_mut().chip.slice.leave = true;
    let _ = uc.emu_stop();
}

/// A block is about to run.
fn on_block(uc: &mut Unicorn<'_, State>, address: u32, size: u32) {
    let state = uc.get_data_mut();
    let chip = &mut state.chip;
    let single = state.notes.single;
    if !single && (chip.slice.leave || chip.clock.cycles >= chip.slice.end) {
        return stop(uc);
    }
    if is_flash(chip, address) && is_flash_busy(chip) {
        state.notes.flash_busy = true;
        return stop(uc);
    }
    if state.notes.traps.any() && !judge_rest_of_it_block(uc, address) {
        return stop(uc);
    }
    let state = uc.get_data_mut();
    let chip = &mut state.chip;
    if single {
        chip.fetch(address, size);
        chip.slice.block = (address, size);
        return;
    }
    if chip.slice.check_exceptions {
        let masks = state.notes.masks.unwrap_or_else(|| masks(uc));
        if uc.get_data().chip.scs.exceptions.deliverable(masks).is_some() {
            return stop(uc);
        }
    }
    let chip = &mut uc.get_data_mut().chip;
    if let Some(watch) = &mut chip.slice.watch {
        let inside = watch.code.contains(address, 1);
        if inside != watch.inside {
            // With an empty TLB, the first access to each page is seen.
            watch.inside = inside;
            chip.slice.flush_tlb = true;
            chip.slice.leave = true;
            return stop(uc);
        }
    }
    let state = uc.get_data_mut();
    let block = state.notes.blocks.inspect_block(&state.chip, address, size);
    let chip = &mut state.chip;
    if block.fpu.is_some() && !chip.scs.fpu_enabled() {
        state.notes.fpu_instruction = block.fpu;
        return stop(uc);
    }
    let mut cycles = block.cycles;
    if chip.costs {
        let (before, len) = chip.slice.block;
        cycles += if before.wrapping_add(len) == address { 0 } else { costs::REFILL };
        if is_flash(chip, address) {
            cycles += state.notes.cache.fetch(address, size, block.instructions, chip.flash.acr());
        }
    }
    chip.fetch(address, size);
    state.notes.located = 0;
    chip.slice.block = (address, size);
    chip.clock.cycles += cycles;
    chip.counters.instructions += block.instructions;
}

/// An instruction outside IT blocks is about to run, and a trap of CCR is set.
fn on_instruction(uc: &mut Unicorn<'_, State>, address: u32) {
    let State { chip, notes } = uc.get_data();
    if (notes.it_block.0..notes.it_block.1).contains(&address) {
        return;
    }
    let Some(instruction) = instruction(chip, address) else { return };
    if let Some(it) = instruction.it_state() {
        let first = address + instruction.len();
        if !may_run_it_block(uc, first, it) {
            stop(uc);
        }
        return;
    }
    if let Some(status) = instruction.traps(notes.traps, |n| base_register(uc, n)) {
        uc.get_data_mut().notes.fault = Some(Fault::usage(status));
        stop(uc);
    }
}

/// A block starts at `address`, perhaps in the middle of an IT block: judges its first instruction.
/// Whether it may start.
fn judge_rest_of_it_block(uc: &mut Unicorn<'_, State>, address: u32) -> bool {
    let xpsr = read(uc, RegisterARM::XPSR);
    let it = traps::it_state(xpsr);
    if it & 0xF == 0 {
        uc.get_data_mut().notes.it_block = (0, 0);
        return true;
    }
    let State { chip, notes } = uc.get_data();
    let status = instruction(chip, address)
        .filter(|_| traps::holds(it >> 4, xpsr))
        .and_then(|instruction| instruction.traps(notes.traps, |n| base_register(uc, n)));
    if let Some(status) = status {
        uc.get_data_mut().notes.fault = Some(Fault::usage(status));
        return false;
    }
    may_run_it_block(uc, address, it)
}

/// Whether the engine may run the instructions from `first` on, whose IT state is `it`, in one go:
/// it does not stop among them. If not, [`Notes::in_doubt`] is the first one to stop at.
fn may_run_it_block(uc: &mut Unicorn<'_, State>, first: u32, it: u8) -> bool {
    let State { chip, notes } = uc.get_data();
    let xpsr = read(uc, RegisterARM::XPSR);
    let (mut at, mut state, mut in_doubt) = (first, it, None);
    while state & 0xF != 0 {
        let Some(instruction) = instruction(chip, at) else { break };
        // What the first one finds is known; the others may find it changed.
        let doubtful = if at == first {
            traps::holds(state >> 4, xpsr)
                && instruction.traps(notes.traps, |n| base_register(uc, n)).is_some()
        } else {
            instruction.may_trap(notes.traps)
        };
        if doubtful {
            in_doubt = in_doubt.or(Some(at));
        }
        at = at.wrapping_add(instruction.len());
        state = traps::advance(state);
    }
    let notes = &mut uc.get_data_mut().notes;
    notes.it_block = (first, at);
    notes.in_doubt = in_doubt.filter(|_| notes.on_the_way_to != in_doubt);
    notes.in_doubt.is_none()
}

fn instruction(chip: &Chip, address: u32) -> Option<Instruction> {
    let (memory, offset) = Cpu::memory(chip, address)?;
    Instruction::take(address, memory.bytes().get(offset..)?)
}

/// r0 to r14.
fn base_register(uc: &Unicorn<'_, State>, number: u32) -> u32 {
    match number {
        13 => read(uc, RegisterARM::SP),
        14 => read(uc, RegisterARM::LR),
        _ => uc.reg_read(RegisterARM::R0 as i32 + number as i32).unwrap_or(0) as u32,
    }
}

/// The properties of a block of instructions that the model needs.
#[derive(Clone, Copy, Debug, Default)]
struct Block {
    instructions: u64,
    /// What they take, but for what the cache of the flash decides.
    cycles: u64,
    /// Address of the first FPU instruction.
    fpu: Option<u32>,
    /// Encoding of the last instruction; the upper half of a 16-bit one is zero.
    last: u32,
}

/// A cache of the blocks that were inspected. [`Cpu::drop_stale`] clears it when code changes. If a
/// program changes its own code in RAM, the cycles of the old code are counted.
struct Blocks {
    inspected: Vec<(u32, u32, Block)>,
    /// Where the instruction ends that accesses a counter of the core, and how many instructions follow. A program
    /// may poll the counter.
    moments: HashMap<Moment, (u32, u64)>,
}

/// An access in a block: the block's address and length, the bytes of it before, access and address.
type Moment = (u32, u32, u32, Access, u32);

impl Default for Blocks {
    fn default() -> Self {
        Self { inspected: vec![(0, 0, Block::default()); Self::SIZE], moments: HashMap::new() }
    }
}

impl Blocks {
    const SIZE: usize = 4096;

    fn inspect_block(&mut self, chip: &Chip, address: u32, size: u32) -> Block {
        let slot = &mut self.inspected[(address >> 1) as usize % Self::SIZE];
        if (slot.0, slot.1) != (address, size) {
            *slot = (address, size, count_instructions(chip, address, size));
        }
        slot.2
    }

    fn clear(&mut self) {
        self.inspected.fill((0, 0, Block::default()));
        self.moments.clear();
    }
}

fn count_instructions(chip: &Chip, address: u32, size: u32) -> Block {
    let mut block = Block::default();
    let Some((memory, offset)) = Cpu::memory(chip, address) else { return block };
    let Some(code) = memory.bytes().get(offset..(offset + size as usize)) else { return block };
    let mut at = 0;
    while at + 2 <= code.len() {
        let first = u16::from_le_bytes([code[at], code[at + 1]]);
        // DDI 0403E A5.1: the upper five bits 11101, 11110, 11111 start a 32-bit instruction.
        let wide = first >> 11 >= 0b11101;
        // Coprocessor space (A5.3.18) with coprocessor number 10 or 11.
        if wide && first & 0xEC00 == 0xEC00 && block.fpu.is_none() {
            let coprocessor = code.get(at + 3).map(|byte| byte & 0x0F);
            if matches!(coprocessor, Some(0xA | 0xB)) {
                block.fpu = Some(address + at as u32);
            }
        }
        block.instructions += 1;
        block.last = u32::from(first);
        at += 2;
        let mut second = 0;
        if wide {
            second = code.get(at..at + 2).map_or(0, |half| u16::from_le_bytes([half[0], half[1]]));
            block.last = block.last << 16 | u32::from(second);
            at += 2;
        }
        block.cycles += if chip.costs { costs::of_instruction(first, second) } else { 1 };
    }
    if chip.costs && chip.geometry.sram.contains(address, 1) {
        block.cycles += costs::of_fetch_from_sram(size);
    }
    block
}

fn is_flash(chip: &Chip, address: u32) -> bool {
    chip.geometry.flash.contains(chip.behind_alias(address).unwrap_or(address), 1)
}

fn is_flash_busy(chip: &mut Chip) -> bool {
    let Some(until) = chip.flash.busy_until() else { return false };
    let now: Time = chip.now();
    until > now
}

/// Whether the FPB replaces words in the page of an address.
fn has_patches(chip: &Chip, address: u32) -> bool {
    [true, false].iter().any(|&code| chip.scs.debug.patches(address, code).next().is_some())
}

/// Makes the copy of a page of the flash with the words that the FPB replaces, and returns the address in it.
/// The words are those of this moment.
fn replace_words(chip: &mut Chip, address: u32, code: bool) -> Option<u32> {
    let patches: Vec<_> = chip.scs.debug.patches(address, code).collect();
    let slot = patches.first()?.0 * PAGE;
    let (memory, offset) = Cpu::memory(chip, address & !(PAGE - 1))?;
    let mut page = memory.bytes()[offset..offset + PAGE as usize].to_vec();
    for (_, at, new) in patches {
        let (memory, offset) = Cpu::memory(chip, new)?;
        page[at..at + 4].copy_from_slice(&memory.bytes()[offset..offset + 4]);
    }
    chip.patched.bytes_mut()[slot as usize..][..page.len()].copy_from_slice(&page);
    Some(PATCHED.base + slot + address % PAGE)
}

/// Unicorn asks for the mapping of a page. Memory is mapped to its own address, and flash also to
/// address 0. A RAM page becomes executable with the first fetch from it, because stores to
/// executable pages are slow.
fn on_tlb_miss(uc: &mut Unicorn<'_, State>, address: u32, kind: MemType) -> Option<TlbEntry> {
    let state = uc.get_data_mut();
    let chip = &mut state.chip;
    let geometry = chip.geometry;
    let entry = |paddr: u32, perms| Some(TlbEntry { paddr: u64::from(paddr), perms });
    if state.notes.balances {
        return entry(address, if kind == MemType::WRITE { Prot::WRITE } else { Prot::READ });
    }
    if !state.notes.asked.insert(address) {
        state.notes.asked_again += 1;
    }
    let paddr = chip.behind_alias(address).unwrap_or(address);
    if HIDDEN.contains(address, 1) || PATCHED.contains(address, 1) {
        return entry(NOWHERE, Prot::READ | Prot::WRITE);
    }
    if SYSTEM_MEMORY.contains(paddr, 1) {
        return entry(paddr, if kind == MemType::WRITE { Prot::WRITE } else { Prot::READ | Prot::EXEC });
    }
    if is_flash(chip, address) {
        let offset = paddr - geometry.flash.base;
        let is_hidden = chip.flash.hides(offset);
        return match kind {
            MemType::READ if chip.flash.is_shut() => {
                state.notes.fault = Some(Fault::bus(cfsr::PRECISERR, Some(address)));
                None
            }
            MemType::FETCH if chip.flash.is_shut() => {
                state.notes.fault = Some(Fault::bus(cfsr::IBUSERR, None));
                None
            }
            // A separate entry that allows only writes; the hook of stores carries out the store.
            MemType::WRITE => entry(paddr, Prot::WRITE),
            MemType::READ if is_flash_busy(chip) => {
                state.notes.flash_busy = true;
                None
            }
            MemType::READ if is_hidden => entry(HIDDEN.base + offset, Prot::READ),
            MemType::READ | MemType::FETCH if has_patches(chip, address) => {
                // Separate entries: fetches and loads are patched separately.
                let is_fetch = kind == MemType::FETCH;
                state.notes.flash_executed[(offset / PAGE) as usize] |= is_fetch;
                let place = replace_words(chip, address, is_fetch).unwrap_or(paddr);
                entry(place, if is_fetch { Prot::EXEC } else { Prot::READ })
            }
            _ => {
                // As for RAM: the first fetch from a page that was only read so far must come here,
                // so that the page is recorded as executed.
                let executed = &mut state.notes.flash_executed[(offset / PAGE) as usize];
                *executed |= kind == MemType::FETCH;
                if is_hidden {
                    return entry(paddr, Prot::EXEC);
                }
                entry(paddr, if *executed { Prot::READ | Prot::EXEC } else { Prot::READ })
            }
        };
    }
    let is_ram = geometry.sram.contains(address, 1) || geometry.ccm.contains(address, 1);
    if let Some(watch) = chip.slice.watch.as_mut().filter(|watch| watch.inside && is_ram) {
        watch.touched.insert(address & !(PAGE - 1));
    }
    if geometry.sram.contains(address, 1) {
        let page = ((address - geometry.sram.base) / PAGE) as usize;
        if kind == MemType::FETCH {
            state.notes.executed[page] = true;
        }
        let perms = if state.notes.executed[page] { Prot::ALL } else { Prot::READ | Prot::WRITE };
        return entry(address, perms);
    }
    if kind == MemType::FETCH {
        let pc = address;
        chip.report(Access::Fetch, pc, 2, 0, pc, "no code can be executed here".into());
        // Peripheral and system space are never executable by the default memory map (PM0214
        // section 2.2.2).
        let never = matches!(address, 0x4000_0000..=0x5FFF_FFFF | 0xA000_0000..);
        state.notes.fault = Some(if never {
            Fault::Configurable { exception: MEM_MANAGE, status: cfsr::IACCVIOL, address: None }
        } else {
            Fault::bus(cfsr::IBUSERR, None)
        });
        return None;
    }
    entry(address, Prot::READ | Prot::WRITE)
}

/// A load or store at an address without memory or peripheral.
fn on_unmapped(uc: &mut Unicorn<'_, State>, kind: MemType, address: u32, size: usize, value: u32) -> bool {
    let pc = read(uc, RegisterARM::PC);
    let state = uc.get_data_mut();
    let size = size as u8;
    let what = "nothing answers here: bus fault".into();
    if kind == MemType::WRITE_UNMAPPED {
        state.chip.report(Access::Write, address, size, value, pc, what);
        state.notes.fault.get_or_insert(Fault::bus(cfsr::IMPRECISERR, None));
    } else {
        state.chip.report(Access::Read, address, size, 0, pc, what);
        state.notes.fault.get_or_insert(Fault::bus(cfsr::PRECISERR, Some(address)));
    }
    false
}

/// A store to flash, or to memory that is always read-only.
fn on_protected_write(uc: &mut Unicorn<'_, State>, address: u32, size: usize, value: u64) -> bool {
    let pc = read(uc, RegisterARM::PC);
    let chip = &mut uc.get_data_mut().chip;
    if is_flash(chip, address) {
        let bytes = value.to_le_bytes();
        chip.store_flash(address, &bytes[..size.min(8)], pc);
    } else {
        let what = if OTP.contains(address, 1) {
            "one-time programmable bytes, which only a debug probe programs here: the write is lost"
        } else {
            "read-only memory: the write is lost"
        };
        chip.report(Access::Write, address, size as u8, value as u32, pc, what.into());
    }
    forget_it_state(uc);
    true
}

/// When a hook runs in the middle of a block, Unicorn stores the position within an IT block in the
/// xPSR and does not clear it. The rest of the block does not use it; but the next block would
/// begin as if it were in that IT block.
fn forget_it_state(uc: &mut Unicorn<'_, State>) {
    let xpsr = read(uc, RegisterARM::XPSR);
    if xpsr & XPSR_IT != 0 {
        let _ = uc.reg_write(RegisterARM::XPSR_NZCVQG, u64::from(xpsr & !XPSR_IT));
    }
}
