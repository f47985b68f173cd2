//! The callgate: what an application may call (`shared_abi::callgate`).
//!
//! The flash controller may be the application's otherwise, and so may the CRC unit and the caches
//! of the flash: they are taken when they are free, and left as they were found.

use core::ffi::c_void;
use core::task::Poll;

use boot_core::canopen::{BitRate, NodeId};
use boot_core::flash::run;
use boot_core::flash::Flash;
use boot_core::store::{Key, NodeParameters, Parameters as _, ProgramRecord, Value};
use bsp::{pac, LAYOUT};
use shared_abi::callgate::{
    Crc32Args, NodeArgs, ProgramArgs, Selector, Status, PROGRAM_INSTALLED, PROGRAM_SIGNED,
};
use shared_abi::geometry::Region;

use crate::caches::Caches;
use crate::flash::ResidentFlash;
use crate::flash_controller::FlashController;
use crate::product::{self, NO_NODE_ID};

/// One way in for all services: the argument structure is looked at, the flash is taken once, the
/// service does its work, and everything is given back as it was found.
///
/// # Safety
/// `args` must point to the argument structure of `selector`; what can be told of a wrong pointer
/// is refused.
pub unsafe extern "C" fn entry(selector: u32, args: *mut c_void) -> i32 {
    let Some(selector) = Selector::from_number(selector) else { return Status::UnknownSelector as i32 };
    let size = match selector {
        Selector::Crc32 => size_of::<Crc32Args>(),
        Selector::ReadNode | Selector::StoreNode => size_of::<NodeArgs>(),
        Selector::ProgramInfo | Selector::Confirm | Selector::Invalidate => size_of::<ProgramArgs>(),
    };
    if !is_in_ram(args as u32, size as u32) {
        return Status::BadPointer as i32;
    }
    // Before the CRC unit gets its clock.
    // SAFETY: two registers are read, which has no effect on their owner.
    if unsafe { FlashController::steal() }.is_in_use() {
        return Status::Busy as i32;
    }
    // SAFETY: the application calls one service at a time and does not use the flash controller
    // meanwhile.
    let rcc = unsafe { pac::RCC::steal() };
    let crc_is_free = rcc.ahb1enr().read().crcen().is_disabled();
    // SAFETY: as above; the CRC unit only where its clock is off.
    let mut flash = unsafe { ResidentFlash::steal(crc_is_free.then_some(&rcc)) };
    // SAFETY: the caller vouches for the structure, and it lies in RAM, aligned.
    let outcome = unsafe {
        match selector {
            Selector::Crc32 => crc32(&flash, &mut *args.cast()),
            Selector::ReadNode => read_node(&flash, &mut *args.cast()),
            Selector::StoreNode => store_node(&mut flash, &*args.cast()),
            Selector::ProgramInfo => program_info(&flash, &mut *args.cast()),
            Selector::Confirm => sign(&mut flash, &*args.cast(), true),
            Selector::Invalidate => sign(&mut flash, &*args.cast(), false),
        }
    };
    if crc_is_free {
        flash.release(&rcc);
    }
    outcome.err().unwrap_or(Status::Ok) as i32
}

/// Whether a structure of this size lies there in RAM, aligned.
fn is_in_ram(address: u32, size: u32) -> bool {
    let chip = LAYOUT.chip;
    address.is_multiple_of(4) && (chip.sram.contains(address, size) || chip.ccm.contains(address, size))
}

fn crc32(flash: &ResidentFlash, args: &mut Crc32Args) -> Result<(), Status> {
    if args.len == 0 || !LAYOUT.chip.flash.contains(args.address, args.len) {
        return Err(Status::BadRange);
    }
    args.crc = flash.crc32(0, Region::new(args.address, args.len));
    Ok(())
}

fn read_node(flash: &ResidentFlash, args: &mut NodeArgs) -> Result<(), Status> {
    let node = product::node_parameters(&product::parameters(flash), flash);
    *args = NodeArgs {
        node_id: node.id.map_or(NO_NODE_ID, NodeId::get).into(),
        bit_rate: node.bit_rate.or_zero(),
    };
    Ok(())
}

fn store_node(flash: &mut ResidentFlash, args: &NodeArgs) -> Result<(), Status> {
    let id = match u8::try_from(args.node_id) {
        Ok(NO_NODE_ID) => None,
        Ok(id) => Some(NodeId::new(id).ok_or(Status::BadArgument)?),
        Err(_) => return Err(Status::BadArgument),
    };
    let bit_rate = BitRate::from_bits_per_second(args.bit_rate).filter(|rate| product::supports(*rate));
    let node = NodeParameters { id, bit_rate: bit_rate.ok_or(Status::BadArgument)? };
    store(flash, Key::Node, node.value())
}

fn program_info(flash: &ResidentFlash, args: &mut ProgramArgs) -> Result<(), Status> {
    let record = ProgramRecord::load(&product::parameters(flash), flash, program(args)?);
    *args = ProgramArgs { number: args.number, ..ProgramArgs::default() };
    if let Some(record) = record {
        args.size = record.size;
        args.crc = record.crc;
        args.version = record.version;
        args.flags = PROGRAM_INSTALLED | if record.signed { PROGRAM_SIGNED } else { 0 };
    }
    Ok(())
}

/// Confirms a program, which releases it for autostart, or takes both away. A confirmed program has
/// not crashed.
fn sign(flash: &mut ResidentFlash, args: &ProgramArgs, signed: bool) -> Result<(), Status> {
    let number = program(args)?;
    let parameters = product::parameters(flash);
    let record = ProgramRecord::load(&parameters, flash, number).ok_or(Status::NoProgram)?;
    let crashes = parameters.get(flash, Key::CrashCount).is_some_and(|[count, ..]| count > 0);
    let told = ProgramRecord { signed, confirmed: signed, ..record };
    if record != told {
        store(flash, Key::Program(number), told.value())?;
    }
    if signed && crashes {
        store(flash, Key::CrashCount, [0; 4])?;
    }
    Ok(())
}

/// The number of a program of the layout.
fn program(args: &ProgramArgs) -> Result<u8, Status> {
    let number = u8::try_from(args.number).map_err(|_| Status::BadArgument)?;
    LAYOUT.program(number).map(|_| number).ok_or(Status::BadArgument)
}

/// Stores a value and waits for it.
fn store(flash: &mut ResidentFlash, key: Key, value: Value) -> Result<(), Status> {
    // They would show words as they were before they were programmed.
    // SAFETY: the application calls one service at a time and does not use the flash controller
    // meanwhile.
    let _caches = unsafe { Caches::off() };
    let mut parameters = product::parameters(flash);
    parameters.store(key, value);
    run(flash, |flash, outcome| parameters.next(flash, outcome)).map_err(|_| Status::Failed)
}
