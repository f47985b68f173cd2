//! One emulated board: chip and CPU in virtual time.

mod debugger;
pub mod image;

use std::collections::BTreeSet;

use shared_abi::geometry::{Geometry, Region, SYSTEM_MEMORY};

use crate::bxcan::BxCan;
use crate::chip::memory_map::OTP;
use crate::chip::Chip;
pub use crate::chip::Counters;
use crate::cpu::{Cpu, Entry, Exit};
pub use crate::error::Error;
use crate::noise::Noise;
pub use crate::options::Options;
pub use crate::periph::flash::{Cells, Cut, FlashCut, FlashTimes, Operation};
pub use crate::periph::rcc::ResetCause;
pub use crate::periph::usart::Usart;
use crate::peripheral::Peripheral;
pub use crate::report::{Access, Report};
use crate::silicon::Silicon;
use crate::slice::Watch;
use crate::supply::Change;
use crate::time::{Span, Time};
use debugger::Debugger;
pub use debugger::Halt;
pub use image::LoadedImage;

/// Why [`Machine::run_until`] came back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The deadline is reached, or passed by less than one block of code.
    Deadline,
    /// The CAN controller needs the bus: a frame is to be sent, or its mode changes.
    Attention,
    /// The chip went through a reset; it is at its first instruction again.
    Reset(ResetCause),
    /// The armed power cut happened, or the board's latch was let go; the machine is off.
    PowerCut,
    /// The CPU has locked up: a fault within the HardFault handler. Only a reset (by the watchdog,
    /// for example) ends it. It is reported once; the machine can be run on.
    Lockup,
    /// A debugger has halted the machine ([`Machine::halted`]): it does not run.
    Halted,
}

/// The state of the CPU: executing or waiting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Activity {
    Off,
    Runs,
    /// WFI.
    Sleeps,
    /// WFE: ends at this time at the latest.
    Dozes {
        until: Time,
    },
    /// The core domain has no supply: only a reset or a wake-up ends it.
    Standby,
    /// The supply is too low: it holds the chip in reset.
    InReset,
    LockedUp,
}

/// A WFE ends after this time even without an event: SEV is invisible to the model, and the
/// architecture allows WFE to end for no reason (DDI 0403E B1.5.18).
const DOZE: Span = Span::from_micros(10);

/// Whether these are one-time programmable bytes, or lock bytes of them.
fn is_otp(address: u32, len: usize) -> bool {
    u32::try_from(len).is_ok_and(|len| OTP.contains(address, len))
}

/// The pin WKUP is PA0 (datasheet, pin definitions).
const WKUP: (usize, u8) = (0, 0);

/// One board.
pub struct Machine {
    cpu: Cpu,
    options: Options,
    activity: Activity,
    /// The time while the power is off.
    off_time: Time,
    power_cycles: u64,
    debugger: Debugger,
}

impl Machine {
    /// A board with an erased flash and no power.
    ///
    /// # Errors
    /// [`Error::Engine`] where the CPU emulation cannot be set up.
    pub fn new(chip: &'static Geometry, options: Options) -> Result<Self, Error> {
        let cpu = Cpu::new(Chip::new(chip, &options))?;
        Ok(Self {
            cpu,
            options,
            activity: Activity::Off,
            off_time: Time(0),
            power_cycles: 0,
            debugger: Debugger::default(),
        })
    }

    /// Stores an ELF file in flash as a debug probe does: bytes outside the image stay unchanged.
    ///
    /// # Errors
    /// [`Error::Image`] or [`Error::Flash`]; the flash is as before then.
    pub fn load(&mut self, image: &[u8]) -> Result<LoadedImage, Error> {
        let (segments, entry) = image::parse_elf(image)?;
        Ok(LoadedImage { segments: self.load_segments(&segments)?, entry: Some(entry) })
    }

    /// Stores an Intel HEX file in flash as a debug probe does.
    ///
    /// # Errors
    /// [`Error::Image`] or [`Error::Flash`]; the flash is as before then.
    pub fn load_hex(&mut self, text: &str) -> Result<LoadedImage, Error> {
        let segments = image::parse_hex(text)?;
        Ok(LoadedImage { segments: self.load_segments(&segments)?, entry: None })
    }

    fn load_segments(&mut self, segments: &[image::Segment]) -> Result<Vec<(u32, u32)>, Error> {
        for segment in segments.iter().filter(|segment| !is_otp(segment.address, segment.bytes.len())) {
            self.check_flash(segment.address, segment.bytes.len())?;
        }
        for segment in segments {
            self.load_bin(segment.address, &segment.bytes)?;
        }
        let len = |segment: &image::Segment| u32::try_from(segment.bytes.len()).unwrap_or(u32::MAX);
        Ok(segments.iter().map(|segment| (segment.address, len(segment))).collect())
    }

    /// Stores bytes in flash, or in the one-time programmable (OTP) bytes, as a debug probe does.
    ///
    /// # Errors
    /// [`Error::Flash`] or [`Error::Address`] where they are not all in flash or in open blocks of the OTP bytes.
    pub fn load_bin(&mut self, address: u32, bytes: &[u8]) -> Result<(), Error> {
        if is_otp(address, bytes.len()) {
            let is_open = self.cpu.chip_mut().program_otp(address, bytes);
            let wanted = "blocks of the OTP bytes that are not locked";
            let refused = Error::Address { address, len: bytes.len(), wanted };
            return if is_open { Ok(()) } else { Err(refused) };
        }
        let offset = self.check_flash(address, bytes.len())?;
        self.cpu.chip_mut().flash.preset(offset, bytes);
        self.note_stale();
        Ok(())
    }

    /// The code that the CPU has of the changed parts of the flash is an old one.
    fn note_stale(&mut self) {
        let chip = self.cpu.chip_mut();
        let (changed, base) = (chip.flash.take_changed(), chip.geometry.flash.base);
        chip.slice.stale.extend(changed.into_iter().map(|(offset, len)| (base + offset, len)));
    }

    /// Puts a program into the system memory, in place of ST's loader, which is not there. It is at 1FFF_0000h.
    ///
    /// # Errors
    /// [`Error::Address`] where it is too long.
    pub fn load_rom(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let Region { base: address, size } = SYSTEM_MEMORY;
        if bytes.len() > size as usize {
            return Err(Error::Address { address, len: bytes.len(), wanted: "system memory" });
        }
        self.cpu.chip_mut().system.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
        self.cpu.forget_translations();
        Ok(())
    }

    fn check_flash(&self, address: u32, len: usize) -> Result<u32, Error> {
        let chip = self.cpu.chip().geometry;
        match u32::try_from(len) {
            Ok(bytes) if chip.flash.contains(address, bytes) => Ok(address - chip.flash.base),
            _ => Err(Error::Flash { address, len, chip }),
        }
    }

    // --- power and reset
    // ---------------------------------------------------------------------------------------------

    /// Power comes up at `now`: RAM holds noise, the chip starts at its reset vector.
    pub fn power_on(&mut self, now: Time) {
        self.lose_ram(1_000);
        self.cpu.chip_mut().power_on(now);
        self.start();
    }

    /// The RAM had no supply, and so many per mille of it have lost their contents.
    fn lose_ram(&mut self, per_mille: u32) {
        self.power_cycles += 1;
        let mut noise = Noise(self.options.seed ^ self.power_cycles.wrapping_mul(0xA24B_AED4_963E_E407));
        let chip = self.cpu.chip_mut();
        for memory in [&mut chip.sram, &mut chip.ccm] {
            for word in memory.bytes_mut().chunks_exact_mut(8) {
                if per_mille >= 1_000 || noise.word() % 1_000 < per_mille.into() {
                    word.copy_from_slice(&noise.word().to_le_bytes());
                }
            }
        }
        self.cpu.forget_translations();
    }

    /// Lets VDD go to `mv` within a time, in a straight line; at once within 0. While the power is off, it is
    /// the voltage at the next power-on.
    pub fn set_supply(&mut self, mv: u32, within: Span) {
        let now = self.now();
        self.cpu.chip_mut().set_supply(mv, within, now);
    }

    /// VDD in mV; 0 while the power is off.
    #[must_use]
    pub fn supply(&self) -> u32 {
        if self.is_powered() {
            self.cpu.chip().vdd()
        } else {
            0
        }
    }

    /// Whether the supply is too low, so that it holds the chip in reset.
    #[must_use]
    pub fn is_held_in_reset(&self) -> bool {
        self.activity == Activity::InReset
    }

    /// The supply takes the chip into reset, or out of it.
    fn follow_supply(&mut self, change: Change) {
        match change {
            Change::Falls => {
                if self.activity == Activity::Standby {
                    self.lose_ram(1_000);
                }
                self.cpu.chip_mut().hold_in_reset();
                self.activity = Activity::InReset;
            }
            Change::Rises { powered_down, ram_lost } => {
                if ram_lost > 0 {
                    self.lose_ram(ram_lost);
                }
                self.cpu.chip_mut().leave_reset(powered_down);
            }
        }
    }

    /// The power goes off; a running flash operation is torn.
    pub fn power_off(&mut self) {
        if self.activity != Activity::Off {
            self.off_time = self.now();
            self.activity = Activity::Off;
            let seed = self.options.seed ^ self.power_cycles;
            let chip = self.cpu.chip_mut();
            chip.flash.lose_power(seed);
            // A controller without power is recessive, as after a reset.
            for can in &mut chip.can {
                can.reset();
            }
            for usart in &mut chip.usarts {
                usart.lose_power();
            }
        }
    }

    /// NRST is pulled low and released.
    pub fn reset_pin(&mut self) {
        if self.is_powered() && !self.is_held_in_reset() {
            self.reset(ResetCause::Pin);
        }
    }

    /// Wakes the chip from Standby, as its real-time clock would, if it is in Standby.
    pub fn wake_up(&mut self) {
        if self.is_in_standby() {
            self.cpu.chip_mut().wake_up();
        }
    }

    /// Whether the chip is in Standby.
    #[must_use]
    pub fn is_in_standby(&self) -> bool {
        self.activity == Activity::Standby
    }

    /// What the manuals leave open, as this chip has it.
    #[must_use]
    pub fn silicon(&self) -> Silicon {
        self.options.silicon
    }

    /// Whether the power is on.
    #[must_use]
    pub fn is_powered(&self) -> bool {
        self.activity != Activity::Off
    }

    fn reset(&mut self, cause: ResetCause) {
        if self.activity == Activity::Standby {
            self.lose_ram(1_000);
        }
        let chip = self.cpu.chip_mut();
        chip.reset(cause);
        chip.counters.resets += 1;
        self.start();
    }

    fn start(&mut self) {
        self.cpu.reset();
        self.debugger.restarted();
        self.activity = Activity::Runs;
    }

    /// Cuts the power at a flash operation, counted from this call on; `None` takes the order back.
    /// A cut ends [`Self::run_until`] with [`Stop::PowerCut`].
    pub fn cut_power_at(&mut self, cut: Option<FlashCut>) {
        self.cpu.chip_mut().flash.cut_power_at(cut);
    }

    /// Keeps the flash operations that start from now on, for [`Self::take_flash_log`].
    pub fn keep_flash_log(&mut self) {
        self.cpu.chip_mut().flash.keep_log();
    }

    /// Takes the flash operations since [`Self::keep_flash_log`], in order; keeps no more.
    pub fn take_flash_log(&mut self) -> Vec<Operation> {
        self.cpu.chip_mut().flash.take_log()
    }

    /// What the flash holds, with the bits between 0 and 1.
    #[must_use]
    pub fn flash_cells(&self) -> Cells {
        self.cpu.chip().flash.cells()
    }

    /// Replaces what the flash of a machine without power holds.
    ///
    /// # Panics
    /// If they are the cells of another chip.
    pub fn set_flash_cells(&mut self, cells: &Cells) {
        let seed = self.options.seed ^ self.power_cycles;
        let chip = self.cpu.chip_mut();
        assert_eq!(cells.bytes.len(), chip.geometry.flash.size as usize, "cells of another chip");
        chip.flash.preset_cells(cells, seed);
        self.note_stale();
    }

    // --- time
    // --------------------------------------------------------------------------------------------------------

    /// The machine's virtual time.
    #[must_use]
    pub fn now(&self) -> Time {
        if self.is_powered() {
            self.cpu.chip().now()
        } else {
            self.off_time
        }
    }

    /// Runs until `deadline`, or until an event that the owner must handle, and returns the reason.
    /// If it returns [`Stop::Deadline`], [`Self::now`] is at `deadline` or less than a block of
    /// code past it.
    pub fn run_until(&mut self, deadline: Time) -> Stop {
        self.cpu.chip_mut().slice.deadline = deadline;
        loop {
            if self.halted().is_some() {
                return Stop::Halted;
            }
            if !self.is_powered() {
                self.off_time = self.off_time.max(deadline);
                return Stop::Deadline;
            }
            let chip = self.cpu.chip_mut();
            chip.advance();
            if chip.flash.power_has_failed() || chip.circuit.lets_go(chip.now()) {
                self.power_off();
                return Stop::PowerCut;
            }
            if let Some(change) = chip.slice.supply.take() {
                self.follow_supply(change);
            }
            let chip = self.cpu.chip_mut();
            if let Some(cause) = chip.slice.reset_request.take() {
                self.reset(cause);
                return Stop::Reset(cause);
            }
            if std::mem::take(&mut chip.slice.attention) {
                return Stop::Attention;
            }
            if chip.now() >= deadline {
                return Stop::Deadline;
            }
            if self.step() == Entry::Lockup {
                self.activity = Activity::LockedUp;
                self.debugger.locked_up();
                return Stop::Lockup;
            }
        }
    }

    /// Makes one thing happen: code runs, an exception is taken, or time passes.
    fn step(&mut self) -> Entry {
        let chip = self.cpu.chip_mut();
        let now = chip.now();
        if let Some(until) = chip.slice.hold_until {
            if now < until {
                let target = chip.next_stop().min(until);
                let is_flash = chip.flash.busy_until().is_some();
                self.skip_to(target);
                let chip = self.cpu.chip_mut();
                let passed = chip.now() - now;
                chip.counters.flash_stall_time.0 += if is_flash { passed.0 } else { 0 };
                return Entry::Taken;
            }
            chip.slice.hold_until = None;
        }
        match self.activity {
            Activity::Runs => self.execute(),
            Activity::Sleeps if self.cpu.wakes() => self.become_active(Activity::Runs),
            Activity::Dozes { until } if now >= until || self.cpu.wakes() => {
                self.become_active(Activity::Runs)
            }
            Activity::Dozes { until } => {
                let target = self.cpu.chip().next_stop().min(until);
                self.skip_to(target);
                Entry::Taken
            }
            Activity::Sleeps | Activity::Standby | Activity::InReset | Activity::LockedUp | Activity::Off => {
                let target = self.cpu.chip().next_stop();
                self.skip_to(target);
                Entry::Taken
            }
        }
    }

    /// The core sleeps, or goes on.
    fn become_active(&mut self, activity: Activity) -> Entry {
        self.cpu.chip_mut().core_sleeps(activity != Activity::Runs);
        self.activity = activity;
        Entry::Taken
    }

    /// The core executes WFI or WFE, or sleeps on exit: it sleeps as `light` says unless SLEEPDEEP is set.
    fn fall_asleep(&mut self, light: Activity) -> Entry {
        match self.cpu.chip().deep_sleep_is_standby() {
            // The option bits have a reset in place of it (section 7.1.1, low-power management reset).
            Some(is_standby)
                if !self.cpu.wakes() && self.cpu.chip().flash.options.low_power_is_reset(is_standby) =>
            {
                let slice = &mut self.cpu.chip_mut().slice;
                slice.reset_request = Some(ResetCause::LowPower);
                return Entry::Taken;
            }
            // With an interrupt pending, WFI does nothing (PM0214 section 3.11.12).
            Some(true) if !self.cpu.wakes() => {
                self.cpu.chip_mut().enter_standby();
                self.activity = Activity::Standby;
                return Entry::Taken;
            }
            Some(false) => {
                let chip = self.cpu.chip_mut();
                let pc = chip.slice.block.0;
                let what = "SLEEPDEEP is set: Stop is not modelled, the CPU sleeps".into();
                chip.report(Access::Read, pc, 2, 0, pc, what);
            }
            Some(true) | None => {}
        }
        self.become_active(light)
    }

    /// Lets time pass up to `target`, and at least a cycle.
    fn skip_to(&mut self, target: Time) {
        let clock = &mut self.cpu.chip_mut().clock;
        let before = clock.cycles;
        clock.skip_to(target);
        clock.cycles = clock.cycles.max(before + 1);
    }

    fn execute(&mut self) -> Entry {
        if let Some(exception) = self.cpu.deliverable() {
            if self.flash_holds(self.cpu.vector_address(exception)) {
                return Entry::Taken;
            }
            let entry = self.cpu.enter_exception(exception);
            return self.debugger.note_exception(entry);
        }
        let chip = self.cpu.chip_mut();
        chip.end_slice_at(chip.next_event());
        let Some(exit) = self.debugger.run_code(&mut self.cpu) else { return Entry::Taken };
        match exit {
            Exit::Slice => Entry::Taken,
            Exit::WaitForInterrupt => self.fall_asleep(Activity::Sleeps),
            Exit::WaitForEvent => self.fall_asleep(Activity::Dozes { until: self.now() + DOZE }),
            Exit::SupervisorCall => self.cpu.supervisor_call(),
            Exit::ExceptionReturn(value) => match self.cpu.return_from_exception(value) {
                Ok(()) => {
                    if self.cpu.ipsr() == 0 && self.cpu.chip().scs.sleeps_on_exit() {
                        return self.fall_asleep(Activity::Sleeps);
                    }
                    Entry::Taken
                }
                Err(fault) => self.cpu.take_fault(fault),
            },
            Exit::FlashBusy => {
                let chip = self.cpu.chip_mut();
                chip.slice.hold_until = chip.flash.busy_until();
                chip.counters.flash_stalls += 1;
                Entry::Taken
            }
            Exit::Breakpoint => self.cpu.breakpoint(),
            Exit::Fault(fault) => self.cpu.take_fault(fault),
        }
    }

    /// Whether a read of `address` has to wait for the flash. The wait begins with this call.
    fn flash_holds(&mut self, address: u32) -> bool {
        let chip = self.cpu.chip_mut();
        let in_flash = chip.geometry.flash.contains(address, 4) || address < chip.geometry.flash.size;
        let busy = chip.flash.busy_until().filter(|_| in_flash);
        if busy.is_some() {
            chip.slice.hold_until = busy;
            chip.counters.flash_stalls += 1;
        }
        busy.is_some()
    }

    // --- the debugger
    // --------------------------------------------------------------------------------------------------

    /// Halts the machine for a debugger that takes over. Returns whether one can: read-out protection of level
    /// 2 switches its port off, and with level 1 the flash is shut until the next power-on.
    pub fn attach_debugger(&mut self) -> bool {
        let chip = self.cpu.chip_mut();
        if !chip.flash.connect_debugger() {
            return false;
        }
        chip.slice.flush_tlb = true;
        chip.scs.debug.is_attached = true;
        self.debugger = Debugger::attached();
        true
    }

    /// Whether a debugger that is attached is denied this address.
    #[must_use]
    pub fn denies_debugger(&self, address: u32) -> bool {
        let chip = self.cpu.chip();
        let address = chip.behind_alias(address).unwrap_or(address);
        chip.flash.is_shut() && chip.geometry.flash.contains(address, 1)
    }

    /// The debugger leaves: its breakpoints go, and the machine goes on.
    pub fn detach_debugger(&mut self) {
        self.debugger = Debugger::default();
        let chip = self.cpu.chip_mut();
        chip.scs.debug.is_attached = false;
        chip.slice.stops.clear();
        chip.slice.breakpoints_changed = true;
    }

    /// Why the machine is halted, if it is.
    #[must_use]
    pub fn halted(&self) -> Option<Halt> {
        self.debugger.halted
    }

    /// Halts the machine where it is.
    pub fn halt(&mut self) {
        self.debugger.halt();
    }

    /// Lets a halted machine go on, or execute one instruction. A step over WFI does not sleep; one
    /// may end at the first instruction of an exception's handler.
    pub fn resume(&mut self, step: bool) {
        self.debugger.resume(step, self.cpu.pc());
    }

    /// Sets or removes a breakpoint. Addresses are those that the program runs at.
    pub fn set_breakpoint(&mut self, address: u32, set: bool) {
        let chip = self.cpu.chip_mut();
        let changed = if set {
            chip.slice.stops.insert(address & !1)
        } else {
            chip.slice.stops.remove(&(address & !1))
        };
        chip.slice.breakpoints_changed |= changed;
    }

    /// r0 to r12, SP, LR, PC, xPSR.
    pub fn core_registers(&mut self) -> [u32; 17] {
        self.cpu.core_registers()
    }

    /// Sets a register, numbered as in [`Self::core_registers`]. Of xPSR, the flags alone change.
    ///
    /// # Panics
    /// For a number above 16.
    pub fn set_core_register(&mut self, number: usize, value: u32) {
        self.cpu.set_core_register(number, value);
    }

    /// Writes memory as a debug probe does: RAM, flash (without erasing it), or a register.
    ///
    /// # Errors
    /// [`Error::Address`] where nothing can be written.
    pub fn poke(&mut self, address: u32, bytes: &[u8]) -> Result<(), Error> {
        if self.write_ram(address, bytes).is_ok() || self.load_bin(address, bytes).is_ok() {
            return Ok(());
        }
        let nothing = || Error::Address { address, len: bytes.len(), wanted: "memory or registers" };
        let &[a, b, c, d] = bytes else { return Err(nothing()) };
        if !address.is_multiple_of(4) || self.register(address).is_none() {
            return Err(nothing());
        }
        let chip = self.cpu.chip_mut();
        chip.store(address, 4, u32::from_le_bytes([a, b, c, d]));
        // No instruction made these accesses, and a debug port takes its time.
        chip.slice.unlocated.clear();
        chip.await_clocks();
        Ok(())
    }

    // --- looking and touching
    // ----------------------------------------------------------------------------------------

    /// The state that a program leaves which has started the independent watchdog with this reload value
    /// in the order of the manual, waits included, and never feeds it. The prescaler stays.
    pub fn preset_watchdog(&mut self, reload: u32) {
        self.cpu.chip_mut().preset_watchdog(reload);
    }

    /// Protects a sector of the flash by its option byte, as a debug probe does, or no longer.
    ///
    /// # Panics
    /// For a sector without a bit of its own.
    pub fn protect_sector(&mut self, number: u8, protected: bool) {
        self.cpu.chip_mut().flash.protect_sector(number, protected);
    }

    /// Sets all option bytes as a debug probe does, in the form of FLASH_OPTCR. Bits that the chip does not
    /// have are shown and have no effect, as has DB1M.
    pub fn set_option_bytes(&mut self, optcr: u32) {
        self.cpu.chip_mut().flash.options.preset_all(optcr);
    }

    /// Sets the option bits BOR_LEV as a debug probe does: the level of the brown-out reset, 1 to 3; 0 for off.
    ///
    /// # Panics
    /// For another level.
    pub fn set_brown_out_level(&mut self, level: u8) {
        self.cpu.chip_mut().flash.options.preset_brown_out_level(level);
    }

    /// Sets the option bit WDG_SW as a debug probe does: whether the watchdog starts with each reset.
    pub fn set_hardware_watchdog(&mut self, on: bool) {
        self.cpu.chip_mut().flash.options.preset_hardware_watchdog(on);
    }

    /// The crystal of the board stops (0), or has this frequency again, in Hz (`Rcc::set_crystal`).
    pub fn set_crystal(&mut self, hz: u32) {
        self.cpu.chip_mut().set_crystal(hz);
    }

    /// Sets the option byte RDP as a debug probe does: AAh no read-out protection, CCh level 2,
    /// anything else level 1.
    pub fn set_read_protection(&mut self, rdp: u8) {
        self.cpu.chip_mut().flash.options.preset_read_protection(rdp);
    }

    /// CAN controller `n`; 0 is CAN1, 1 is CAN2.
    ///
    /// # Panics
    /// When there is no such controller.
    pub fn can_mut(&mut self, n: usize) -> &mut BxCan {
        &mut self.cpu.chip_mut().can[n]
    }

    /// The CAN controller that the board's transceiver is at ([`Options::transceiver`]).
    ///
    /// # Panics
    /// When there is no such controller.
    pub fn wired_can_mut(&mut self) -> &mut BxCan {
        self.can_mut(self.options.transceiver)
    }

    /// The USART with this name (`"USART2"`); `None` where the chip has no such one.
    pub fn usart_mut(&mut self, name: &str) -> Option<&mut Usart> {
        self.cpu.chip_mut().usarts.iter_mut().find(|usart| usart.instance().name == name)
    }

    /// All its USARTs.
    pub fn usarts_mut(&mut self) -> &mut [Usart] {
        &mut self.cpu.chip_mut().usarts
    }

    /// The flash array, as a load of the CPU sees it.
    #[must_use]
    pub fn flash(&self) -> &[u8] {
        self.cpu.chip().flash.array.bytes()
    }

    /// Copies memory (flash, RAM, CCM, system page) into `buffer`.
    ///
    /// # Errors
    /// [`Error::Address`] where it is not all memory.
    pub fn read_memory(&self, address: u32, buffer: &mut [u8]) -> Result<(), Error> {
        if self.cpu.read_memory(address, buffer) {
            Ok(())
        } else {
            Err(Error::Address { address, len: buffer.len(), wanted: "memory" })
        }
    }

    /// The word of a peripheral's or the core's register as a load would give it, whether the
    /// peripheral has a clock or not; `None` where nothing is modelled. What a load does to a
    /// register is done, so this is for machines that are looked at and left.
    pub fn register(&mut self, address: u32) -> Option<u32> {
        self.cpu.chip_mut().register(address)
    }

    /// Writes into RAM.
    ///
    /// # Errors
    /// [`Error::Address`] where it is not all RAM.
    pub fn write_ram(&mut self, address: u32, bytes: &[u8]) -> Result<(), Error> {
        if self.cpu.write_ram(address, bytes) {
            Ok(())
        } else {
            Err(Error::Address { address, len: bytes.len(), wanted: "RAM" })
        }
    }

    /// The program counter.
    #[must_use]
    pub fn pc(&self) -> u32 {
        self.cpu.pc()
    }

    /// Drives a pin from outside (`Some`), or lets it go (`None`). Ports that the chip does not
    /// have are ignored.
    pub fn set_pin(&mut self, port: char, pin: u8, level: Option<bool>) {
        if let Some(index) = port_index(port) {
            let before = self.pin(port, pin);
            let chip = self.cpu.chip_mut();
            if let Some(port) = chip.gpio.get_mut(index) {
                port.set_outside(pin, level);
                chip.show_pins();
            }
            let rises = !before && self.pin(port, pin);
            if (index, pin) == WKUP && rises && self.cpu.chip_mut().wkup_rises() {
                self.wake_up();
            }
        }
    }

    /// The level at a pin; low where there is no such port.
    #[must_use]
    pub fn pin(&self, port: char, pin: u8) -> bool {
        port_index(port).and_then(|index| self.cpu.chip().gpio.get(index)).is_some_and(|port| port.level(pin))
    }

    /// The accesses of the program that the model does not cover, or that the chip would punish.
    #[must_use]
    pub fn reports(&self) -> &[Report] {
        self.cpu.chip().reports.as_slice()
    }

    /// Records from now on which RAM the code in this region accesses.
    pub fn watch(&mut self, code: Region) {
        self.cpu.chip_mut().slice.watch = Some(Watch { code, inside: false, touched: BTreeSet::new() });
    }

    /// Returns the pages of RAM (4 KiB, by their first addresses) that the watched code has
    /// accessed since the last call.
    pub fn take_touched(&mut self) -> Vec<u32> {
        let watch = self.cpu.chip_mut().slice.watch.as_mut();
        watch.map(|watch| std::mem::take(&mut watch.touched).into_iter().collect()).unwrap_or_default()
    }

    /// The counters.
    #[must_use]
    pub fn counters(&self) -> Counters {
        let chip = self.cpu.chip();
        Counters {
            cycles: chip.clock.cycles,
            longest_between_feeds: chip.iwdg.longest_between_feeds(),
            longest_between_toggles: chip.circuit.longest(),
            ..chip.counters.clone()
        }
    }

    /// How often translated code was entered: the measure of what an idle machine costs the host.
    #[must_use]
    pub fn entries(&self) -> u64 {
        self.cpu.chip().slice.entries
    }

    /// The core clock that the program has set up, in Hz.
    #[must_use]
    pub fn core_clock(&self) -> u32 {
        self.cpu.chip().clocks().hclk
    }

    /// Why the faults since the last reset were taken, in words: their kinds, the address of a load or store,
    /// and the program counter of the last one's stack frame, or of the CPU that has locked up.
    #[must_use]
    pub fn fault_cause(&self) -> String {
        let scs = &self.cpu.chip().scs;
        let cause = crate::cortex::scs::cause(scs.cfsr, scs.hfsr, scs.bfar);
        format!("{cause}; pc {:08X}h", self.pc())
    }
}

fn port_index(port: char) -> Option<usize> {
    ('A'..='K').position(|name| name == port.to_ascii_uppercase())
}
