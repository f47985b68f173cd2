//! The callgate: the services that an application may call (`shared_abi::callgate`).
//!
//! The application, and its interrupts, may use the CRC unit and the caches of the flash; the application
//! the flash controller. The callgate takes them when they are free, and leaves them as it found them.
//! It only adds values to the journal: an erase would stop the application for half a second.
//!
//! Before a sealed program starts, the boot stage locks the flash (`flash_lock.rs`): nothing can be
//! stored then before the next reset, and a write of a key would be a bus error in the application.
//! The application leaves its request in the warm-start cell, and the boot stage stores it.

use core::ffi::c_void;

use boot_core::canopen::{BitRate, NodeId};
use boot_core::decision::crash_count;
use boot_core::flash::Flash;
use boot_core::renewal::{check, header, identification, Places};
use boot_core::store::{Key, NodeParameters, Parameters as _, ProgramRecord, RenewalRecord, Seal, Value};
use bsp::{pac, LAYOUT};
use shared_abi::callgate::{
    Crc32Args, NodeArgs, ProgramArgs, Selector, Status, PROGRAM_INSTALLED, PROGRAM_SIGNED,
};
use shared_abi::geometry::Region;
use shared_abi::handoff::Handoff;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::warm_start::BootRequest;

use crate::flash::{CrcUnit, ResidentFlash};
use crate::flash_controller::FlashController;
use crate::ram_image::{home, HOST};
use crate::storing::store;
use product::{self, NO_NODE_ID, PRODUCT, SEALED};

/// The entry of all services: it checks the argument structure, takes the flash once, calls the
/// service, and leaves everything as it found it.
///
/// # Safety
/// `args` must point to the argument structure of `selector`; a pointer that is wrong beyond doubt
/// is refused.
pub unsafe extern "C" fn entry(selector: u32, args: *mut c_void) -> i32 {
    let Some(selector) = Selector::from_number(selector) else { return Status::UnknownSelector as i32 };
    let size = match selector {
        Selector::Crc32 => size_of::<Crc32Args>(),
        Selector::ReadNode | Selector::StoreNode => size_of::<NodeArgs>(),
        _ => size_of::<ProgramArgs>(),
    };
    if !is_in_ram(args as u32, size as u32) {
        return Status::BadPointer as i32;
    }
    // SAFETY: it reads two registers, which has no effect on their owner.
    if unsafe { FlashController::steal() }.is_in_use() {
        return Status::Busy as i32;
    }
    // SAFETY: the application calls one service at a time and does not use the flash controller
    // during the call.
    let (rcc, mut flash) = unsafe { (pac::RCC::steal(), ResidentFlash::steal(CrcUnit::Shared)) };
    // SAFETY: the caller guarantees the structure, and it lies in RAM, aligned.
    let outcome = unsafe {
        match selector {
            Selector::Crc32 => crc32(&flash, &mut *args.cast()),
            Selector::ReadNode | Selector::StoreNode => node(selector, &mut flash, &mut *args.cast(), false),
            _ => program(selector, &mut flash, &mut *args.cast()),
        }
    };
    flash.release(&rcc);
    outcome.err().unwrap_or(Status::Ok) as i32
}

/// Whether the address is aligned and a structure of this size there is in RAM.
fn is_in_ram(address: u32, size: u32) -> bool {
    let chip = LAYOUT.chip;
    address.is_multiple_of(4) && (chip.sram.contains(address, size) || chip.ccm.contains(address, size))
}

/// Stores a value, unless the flash is locked.
fn keep(
    parameters: &mut product::Parameters,
    flash: &mut ResidentFlash,
    key: Key,
    value: Value,
) -> Result<(), Status> {
    if is_locked(parameters, flash) {
        return Err(Status::Locked);
    }
    let is_full = parameters.is_nearly_full();
    store(parameters, flash, key, value).map_err(|_| if is_full { Status::Full } else { Status::Failed })
}

/// Whether the boot stage locked the flash before it started the running program.
fn is_locked(parameters: &product::Parameters, flash: &ResidentFlash) -> bool {
    if !SEALED {
        return false;
    }
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image.
    let program = unsafe { Handoff::read_program(LAYOUT.handoff.base as *const Handoff) };
    let record = parameters.program(flash, program);
    record.is_some_and(|record| record.seal == Some(Seal::Locked))
}

/// Stores the values that an application requested before its reset. A refused request changes
/// nothing; the application sees that when it reads the values.
pub fn store_after_reset(flash: &mut ResidentFlash, request: Option<BootRequest>) {
    // The program for which the flash was locked does not run any more.
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image.
    let unlock = || unsafe { Handoff::erase(LAYOUT.handoff.base as *mut Handoff) };
    let (selector, number) = match request {
        Some(BootRequest::Confirm(number)) => (Selector::Confirm, number),
        Some(BootRequest::Invalidate(number)) => (Selector::Invalidate, number),
        Some(BootRequest::StoreNode(node)) => {
            unlock();
            let node_id = node.node_id.into();
            let mut args = NodeArgs { node_id, bit_rate: node.bits_per_second() };
            let _ = self::node(Selector::StoreNode, flash, &mut args, true);
            return;
        }
        _ => return,
    };
    unlock();
    let _ = program(selector, flash, &mut ProgramArgs { number: number.into(), ..ProgramArgs::default() });
}

fn crc32(flash: &ResidentFlash, args: &mut Crc32Args) -> Result<(), Status> {
    if args.len == 0 || !LAYOUT.chip.flash.contains(args.address, args.len) {
        return Err(Status::BadRange);
    }
    args.crc = flash.crc32(0, Region::new(args.address, args.len));
    Ok(())
}

/// Returns or stores node-ID and bit rate. The last places of the journal are for what cannot wait: confirmations, and
/// what the boot stage stores (`to_the_last`).
fn node(
    selector: Selector,
    flash: &mut ResidentFlash,
    args: &mut NodeArgs,
    to_the_last: bool,
) -> Result<(), Status> {
    let mut parameters = product::parameters(flash);
    if selector == Selector::ReadNode {
        let node = product::node_parameters(&parameters, flash);
        *args = NodeArgs { node_id: node.id_or_none().into(), bit_rate: node.bit_rate.or_zero() };
        return Ok(());
    }
    let is_allowed = |id: &u8| PRODUCT.node.ids.contains(id) || *id == NO_NODE_ID;
    let id = u8::try_from(args.node_id).ok().filter(is_allowed).ok_or(Status::BadArgument)?;
    let bit_rate = BitRate::from_bits_per_second(args.bit_rate).filter(|rate| product::supports(*rate));
    let node = NodeParameters { id: NodeId::new(id), bit_rate: bit_rate.ok_or(Status::BadArgument)? };
    if !to_the_last && parameters.is_nearly_full() && !is_locked(&parameters, flash) {
        return Err(Status::Full);
    }
    keep(&mut parameters, flash, Key::NODE, node.value())
}

/// The RAM image as a program: what 1F56h and 2005h of it read. As long as home is partly written, it is the one in
/// staging. An image for the bench has no CRC to judge it by: it is only ever at home.
fn own_info(flash: &ResidentFlash, record: Option<RenewalRecord>) -> ProgramArgs {
    let order = Places::of(LAYOUT).map_or([None; 2], |places| places.order(flash, record, false));
    let is_good = |place: &Region| check(flash, *place, LAYOUT, HOST).is_ok();
    let good = order.into_iter().flatten().map(|(place, _)| place).find(is_good);
    let place = good.unwrap_or_else(home);
    let header = header(flash, place);
    ProgramArgs {
        number: BOOTLOADER.into(),
        size: header.total(),
        crc: identification(flash, place, &header),
        version: header.version,
        flags: PROGRAM_INSTALLED,
    }
}

/// Reports about a program, confirms it (which also signs it, so that it may start by itself),
/// takes back both, or the confirmation alone. A confirmation clears the crash count.
fn program(selector: Selector, flash: &mut ResidentFlash, args: &mut ProgramArgs) -> Result<(), Status> {
    let number = u8::try_from(args.number).map_err(|_| Status::BadArgument)?;
    if product::RENEWS && number == BOOTLOADER && selector == Selector::ProgramInfo {
        *args = own_info(flash, RenewalRecord::load(&product::parameters(flash), flash));
        return Ok(());
    }
    LAYOUT.program(number).ok_or(Status::BadArgument)?;
    let mut parameters = product::parameters(flash);
    let record = parameters.program(flash, number);
    if selector == Selector::ProgramInfo {
        *args = ProgramArgs { number: args.number, ..ProgramArgs::default() };
        if let Some(record) = record {
            args.size = record.size;
            args.crc = record.crc;
            args.version = record.version;
            args.flags = PROGRAM_INSTALLED | if record.signed { PROGRAM_SIGNED } else { 0 };
        }
        return Ok(());
    }
    let record = record.ok_or(Status::NoProgram)?;
    let confirmed = selector == Selector::Confirm;
    if SEALED && selector == Selector::Unconfirm && record.is_sealed() {
        return Err(Status::Locked);
    }
    let signed = if selector == Selector::Unconfirm { record.signed } else { confirmed };
    if record.signed != signed || record.confirmed != confirmed {
        let reported = ProgramRecord { signed, confirmed, ..record };
        keep(&mut parameters, flash, Key::program(number), reported.value())?;
    }
    if confirmed && crash_count(&parameters, flash) > 0 {
        keep(&mut parameters, flash, Key::CRASH_COUNT, [0; 4])?;
    }
    Ok(())
}
