//! What Unicorn asks while code runs: a page, a load or store outside of memory, a block or an
//! instruction that is about to run.

use shared_abi::geometry::SYSTEM_MEMORY;
use unicorn_engine::unicorn_const::{uc_error, HookType, MemType, Prot, TlbEntry};
use unicorn_engine::{RegisterARM, UcHookId, Unicorn};

use super::blocks::count_instructions;
use super::instruction::{self, Instruction};
use super::{failed, masks, read, Cpu, Fault, Notes, Poll, State, NOWHERE, XPSR_IT};
use crate::chip::memory_map::{
    counts_cycles, HIDDEN, OPTION_PAGE, OTP, PATCHED, PERIPHERALS, PERIPHERALS_AHB2, PERIPHERAL_ALIAS,
    PRIVATE, SRAM_ALIAS, SYSTEM,
};
use crate::chip::Chip;
use crate::cortex::exceptions::MEM_MANAGE;
use crate::cortex::scs::{cfsr, RefusedStore};
use crate::costs;
use crate::error::Error;
use crate::memory::{HostMemory, PAGE};
use crate::report::Access;
use crate::time::Time;

/// The register whose bit BSY programs wait for.
const FLASH_SR: u32 = 0x4002_3C0C;
/// A loop whose RAM was another one so often counts its rounds there.
const MOST_COUNTS: u8 = 3;

impl Cpu {
    pub(super) fn map_memories(&mut self) -> Result<(), Error> {
        let chip = &self.uc.get_data().chip;
        let pointer = |memory: &HostMemory| (memory.as_ptr(), memory.size() as u64);
        let (flash, sram, ccm) = (chip.geometry.flash, chip.geometry.sram, chip.geometry.ccm);
        let ccm = (ccm.size > 0).then(|| (ccm.base, pointer(&chip.ccm), Prot::READ | Prot::WRITE));
        let blocks = [
            (flash.base, pointer(&chip.flash.array), Prot::READ | Prot::EXEC),
            (sram.base, pointer(&chip.sram), Prot::ALL),
            (SYSTEM.base, pointer(&chip.system), Prot::READ | Prot::EXEC),
            (OPTION_PAGE.base, pointer(&chip.options), Prot::READ),
            (PATCHED.base, pointer(&chip.patched), Prot::READ | Prot::EXEC),
        ];
        for (base, (memory, len), perms) in blocks.into_iter().chain(ccm) {
            // SAFETY: the memory belongs to the chip, which the engine's data owns: the engine is
            // closed before its data is dropped. Its length is a multiple of the page size
            // (`HostMemory::new`).
            unsafe { self.uc.mem_map_ptr(base.into(), len, perms, memory.cast()) }
                .map_err(failed("mapping memory"))?;
            // Mapping alone would let stores through to read-only memory without the hook.
            self.uc.mem_protect(base.into(), len, perms).map_err(failed("protecting memory"))?;
        }
        Ok(())
    }

    /// Maps what is no memory: loads and stores become calls.
    pub(super) fn map_registers(&mut self) -> Result<(), uc_error> {
        for region in [PERIPHERALS, PERIPHERALS_AHB2, PERIPHERAL_ALIAS, PRIVATE] {
            let base = region.base;
            self.uc.mmio_map(
                base.into(),
                region.size.next_multiple_of(PAGE).into(),
                Some(move |uc: &mut Unicorn<'_, State>, offset: u64, size: usize| {
                    let address = base + offset as u32;
                    note_moment(uc, Access::Read, address);
                    let value = uc.get_data_mut().chip.load(address, size as u8);
                    if address == FLASH_SR {
                        skip_rounds(uc);
                    } else {
                        uc.get_data_mut().notes.poll = None;
                    }
                    locate_reports(uc);
                    u64::from(value)
                }),
                Some(move |uc: &mut Unicorn<'_, State>, offset: u64, size: usize, value: u64| {
                    let address = base + offset as u32;
                    note_moment(uc, Access::Write, address);
                    uc.get_data_mut().notes.poll = None;
                    uc.get_data_mut().chip.store(address, size as u8, value as u32);
                    settle_bus_error(uc);
                    locate_reports(uc);
                }),
            )?;
        }
        self.uc.mmio_map(
            HIDDEN.base.into(),
            HIDDEN.size.into(),
            Some(|uc: &mut Unicorn<'_, State>, _: u64, _: usize| {
                uc.get_data_mut().chip.flash.load_hidden();
                0
            }),
            None::<fn(&mut Unicorn<'_, State>, u64, usize, u64)>,
        )?;
        let sram = self.uc.get_data().chip.geometry.sram;
        self.uc.mmio_map(
            SRAM_ALIAS.into(),
            u64::from(sram.size) * 32,
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
    }

    pub(super) fn add_hooks(&mut self) -> Result<(), uc_error> {
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

    /// Has every instruction looked at while a trap of CCR is set, and none otherwise: it costs
    /// time.
    pub(super) fn set_traps(&mut self) {
        let State { chip, notes } = self.uc.get_data_mut();
        notes.traps = chip.scs.traps();
        if notes.traps.any() != notes.trap_hook.is_some() {
            self.switch(
                |notes| &mut notes.trap_hook,
                |uc| uc.add_code_hook(1, 0, |uc, address, _| on_instruction(uc, address as u32)),
            );
        }
    }

    /// Has every load from flash noticed while the data cache is in the way, and none otherwise: it costs time.
    /// The loads in the rest of the block that switches the cache on are not noticed.
    pub(super) fn watch_loads(&mut self) {
        let State { chip, notes } = self.uc.get_data_mut();
        let flash = chip.geometry.flash;
        let (first, last) = (u64::from(flash.base), u64::from(flash.end() - 1));
        if chip.flash.caches_data() != notes.load_hook.is_some() {
            self.switch(
                |notes| &mut notes.load_hook,
                |uc| {
                    uc.add_mem_hook(HookType::MEM_READ, first, last, |uc, _, address, size, _| {
                        uc.get_data_mut().chip.load_flash(address as u32, size as u32);
                        forget_it_state(uc);
                        true
                    })
                },
            );
        }
    }

    /// Removes a hook, or adds it.
    fn switch(
        &mut self,
        hook: fn(&mut Notes) -> &mut Option<UcHookId>,
        add: impl FnOnce(&mut Unicorn<'static, State>) -> Result<UcHookId, uc_error>,
    ) {
        let added = match hook(&mut self.uc.get_data_mut().notes).take() {
            Some(old) => {
                let _ = self.uc.remove_hook(old);
                None
            }
            None => add(&mut self.uc).ok(),
        };
        *hook(&mut self.uc.get_data_mut().notes) = added;
        // Code that is translated already does not look for hooks.
        let _ = self.uc.ctl_flush_tb();
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
    let (memory, offset) = chip.memory(start)?;
    let code = memory.bytes().get(offset + from as usize..offset + size as usize)?;
    let registers = std::array::from_fn(|n| base_register(uc, n as u32));
    instruction::find(code, &registers, access, address).map(|offset| from + offset)
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

/// A load of FLASH_SR. A program that asks again with all registers and its RAM as they were, and with no event, no
/// exception and no other register of a peripheral in between, waits for BSY in a loop. The rounds up to the next
/// event pass in one piece, each with its cycles: the loop is where it would be. The host needs more time for them
/// than the chip, and its clients would wait.
fn skip_rounds(uc: &mut Unicorn<'_, State>) {
    let State { chip, notes } = uc.get_data_mut();
    if chip.flash.busy_until().is_none() || notes.single {
        notes.poll = None;
        return;
    }
    let core = [RegisterARM::LR, RegisterARM::SP, RegisterARM::PC, RegisterARM::XPSR].map(|it| read(uc, it));
    let general = std::array::from_fn(|n| uc.reg_read(RegisterARM::R0 as i32 + n as i32).unwrap_or(0) as u32);
    let State { chip, notes } = uc.get_data_mut();
    let cycles = chip.clock.cycles;
    let mut poll = Poll { entry: chip.slice.entries, cycles, core, general, ram: None, counts: 0 };
    let is_same = |before: &Poll| Poll { cycles, ram: None, counts: 0, ..*before } == poll;
    if let Some(before) = notes.poll.filter(is_same) {
        poll.counts = before.counts;
        if before.counts < MOST_COUNTS {
            poll.ram = Some(checksum(chip.sram.bytes()) ^ checksum(chip.ccm.bytes()).rotate_left(1));
        }
        if poll.ram.is_some() && poll.ram == before.ram {
            let round = (cycles - before.cycles).max(1);
            poll.cycles += chip.slice.end.saturating_sub(cycles) / round * round;
            chip.clock.cycles = poll.cycles;
        } else if before.ram.is_some() {
            poll.counts += 1;
        }
    }
    notes.poll = Some(poll);
}

/// A checksum that changes with a word, and with two that change by the same amount.
fn checksum(bytes: &[u8]) -> u64 {
    let (words, _) = bytes.as_chunks::<4>();
    let words = words.iter().map(|word| u64::from(u32::from_le_bytes(*word)));
    words.fold(0, |sum: u64, word| sum.wrapping_add(word.wrapping_mul(word ^ 0x9E37_79B9)))
}

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
    if chip.is_flash(address) && is_flash_busy(chip) {
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
        if chip.is_flash(address) {
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
    let it = instruction::it_state(xpsr);
    if it & 0xF == 0 {
        uc.get_data_mut().notes.it_block = (0, 0);
        return true;
    }
    let State { chip, notes } = uc.get_data();
    let status = instruction(chip, address)
        .filter(|_| instruction::holds(it >> 4, xpsr))
        .and_then(|instruction| instruction.traps(notes.traps, |n| base_register(uc, n)));
    if let Some(status) = status {
        uc.get_data_mut().notes.fault = Some(Fault::usage(status));
        return false;
    }
    may_run_it_block(uc, address, it)
}

/// Whether the engine may run the instructions from `first` on, whose IT state is `it`, in one go:
/// it does not stop among them. If not, `Notes::in_doubt` is the first one to stop at.
fn may_run_it_block(uc: &mut Unicorn<'_, State>, first: u32, it: u8) -> bool {
    let State { chip, notes } = uc.get_data();
    let xpsr = read(uc, RegisterARM::XPSR);
    let (mut at, mut state, mut in_doubt) = (first, it, None);
    while state & 0xF != 0 {
        let Some(instruction) = instruction(chip, at) else { break };
        // What the first one finds is known; the others may find it changed.
        let doubtful = if at == first {
            instruction::holds(state >> 4, xpsr)
                && instruction.traps(notes.traps, |n| base_register(uc, n)).is_some()
        } else {
            instruction.may_trap(notes.traps)
        };
        if doubtful {
            in_doubt = in_doubt.or(Some(at));
        }
        at = at.wrapping_add(instruction.len());
        state = instruction::advance(state);
    }
    let notes = &mut uc.get_data_mut().notes;
    notes.it_block = (first, at);
    notes.in_doubt = in_doubt.filter(|_| notes.on_the_way_to != in_doubt);
    notes.in_doubt.is_none()
}

fn instruction(chip: &Chip, address: u32) -> Option<Instruction> {
    let (memory, offset) = chip.memory(address)?;
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
    let (memory, offset) = chip.memory(address & !(PAGE - 1))?;
    let mut page = memory.bytes()[offset..offset + PAGE as usize].to_vec();
    for (_, at, new) in patches {
        let (memory, offset) = chip.memory(new)?;
        page[at..at + 4].copy_from_slice(&memory.bytes()[offset..offset + 4]);
    }
    chip.patched.bytes_mut()[slot as usize..][..page.len()].copy_from_slice(&page);
    Some(PATCHED.base + slot + address % PAGE)
}

fn entry(address: u32, perms: Prot) -> Option<TlbEntry> {
    Some(TlbEntry { paddr: address.into(), perms })
}

/// Unicorn asks for the mapping of a page. Memory is mapped to its own address, and flash also to
/// address 0. A RAM page becomes executable with the first fetch from it, because stores to
/// executable pages are slow.
fn on_tlb_miss(uc: &mut Unicorn<'_, State>, address: u32, kind: MemType) -> Option<TlbEntry> {
    let state = uc.get_data_mut();
    let chip = &mut state.chip;
    let geometry = chip.geometry;
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
    if chip.is_flash(address) {
        return flash_entry(state, address, paddr, kind);
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

/// The same for a page of the flash, which is at `paddr`.
fn flash_entry(state: &mut State, address: u32, paddr: u32, kind: MemType) -> Option<TlbEntry> {
    let State { chip, notes } = state;
    let offset = paddr - chip.geometry.flash.base;
    let page = (offset / PAGE) as usize;
    let is_hidden = chip.flash.hides(offset);
    match kind {
        MemType::READ if chip.flash.is_shut() => {
            notes.fault = Some(Fault::bus(cfsr::PRECISERR, Some(address)));
            None
        }
        MemType::FETCH if chip.flash.is_shut() => {
            notes.fault = Some(Fault::bus(cfsr::IBUSERR, None));
            None
        }
        // A separate entry that allows only writes; the hook of stores carries out the store.
        MemType::WRITE => entry(paddr, Prot::WRITE),
        MemType::READ if is_flash_busy(chip) => {
            notes.flash_busy = true;
            None
        }
        MemType::READ if is_hidden => entry(HIDDEN.base + offset, Prot::READ),
        MemType::READ | MemType::FETCH if has_patches(chip, address) => {
            // Separate entries: fetches and loads are patched separately.
            let is_fetch = kind == MemType::FETCH;
            notes.flash_executed[page] |= is_fetch;
            let place = replace_words(chip, address, is_fetch).unwrap_or(paddr);
            entry(place, if is_fetch { Prot::EXEC } else { Prot::READ })
        }
        _ => {
            // As for RAM: the first fetch from a page that was only read so far must come here,
            // so that the page is recorded as executed.
            notes.flash_executed[page] |= kind == MemType::FETCH;
            match notes.flash_executed[page] {
                _ if is_hidden => entry(paddr, Prot::EXEC),
                true => entry(paddr, Prot::READ | Prot::EXEC),
                false => entry(paddr, Prot::READ),
            }
        }
    }
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
    if chip.is_flash(address) {
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
