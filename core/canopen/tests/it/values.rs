//! Values of objects as CiA 301, CiA 302-3 and CiA 305 give them, and what a device answers that
//! implements no more than it must.

use canopen::debugger::Stop;
use canopen::device::Device;
use canopen::od::{Access, DataType, Entry, Table};
use canopen::program::{control_count, region_of, region_value, Numbers};
use canopen::{AbortCode, Address, BitRate, CobId, Instant, NodeId, Objects};

#[test]
fn bit_rates_are_found_by_their_number_of_bits() {
    let table = [1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000];
    assert_eq!(BitRate::TABLE, table);
    for (index, rate) in (0..).zip(table) {
        assert_eq!(BitRate::from_bits_per_second(rate), BitRate::from_index(index));
        assert_eq!(BitRate::from_index(index).unwrap().or_zero(), rate);
    }
    assert_eq!(BitRate::from_bits_per_second(0), Some(BitRate::Auto));
    assert_eq!(BitRate::Auto.or_zero(), 0);
    assert_eq!(BitRate::from_bits_per_second(1), None);
}

/// CiA 301 table 65: the objects of the identification; every other address is not its own.
#[test]
fn a_device_reads_its_objects() {
    let device = Device {
        device_type: 0x0001_0191,
        name: "pump",
        hardware_version: "h1",
        software_version: "s22",
        heartbeat_ms: 0x0102,
        vendor_id: 0x11,
        product_code: 0x2222,
        revision: 0x0003_0001,
        serial_number: 0x4444_4444,
    };
    for (index, sub, value) in [
        (0x1000, 0, &[0x91, 1, 1, 0][..]),
        (0x1001, 0, &[0]),
        (0x1008, 0, b"pump"),
        (0x1009, 0, b"h1"),
        (0x100A, 0, b"s22"),
        (0x1017, 0, &[2, 1]),
        (0x1018, 1, &[0x11, 0, 0, 0]),
        (0x1018, 2, &[0x22, 0x22, 0, 0]),
        (0x1018, 3, &[1, 0, 3, 0]),
        (0x1018, 4, &[0x44; 4]),
    ] {
        let mut buf = [0; 8];
        let len = device.read(Address::new(index, sub), &mut buf).unwrap().unwrap();
        assert_eq!(&buf[..len], value, "{index:04X}h/{sub}");
    }
    assert_eq!(device.read(Address::new(0x1018, 5), &mut [0; 8]), None);
}

#[test]
fn a_region_is_its_base_and_then_its_size() {
    assert_eq!(region_value(0x0801_0000, 0x000F_0000), [0, 0, 1, 8, 0, 0, 0x0F, 0]);
    assert_eq!(region_of([0, 0, 1, 8, 0, 0, 0x0F, 0]), (0x0801_0000, 0x000F_0000));
}

/// Each array has sub-index 0 and one for each program.
#[test]
fn a_table_has_the_arrays_of_program_control() {
    const NUMBERS: Numbers = Numbers::of_programs(2);
    const LEN: usize = control_count(NUMBERS);
    let entries = Table::<LEN>::EMPTY.with_program_control(NUMBERS).entries();
    let subs: Vec<u8> = entries.iter().map(|entry| entry.at.sub).collect();
    assert_eq!(subs, [0, 1, 2].repeat(LEN / 3));
    assert!(entries.chunks(3).all(|of| of.iter().all(|entry| entry.at.index == of[0].at.index)));
    assert!(entries.iter().any(|entry| entry.at == Address::new(0x1F51, 2)));
}

/// ESAcademy's emergency types: 1 is a code breakpoint; those from 80h on are coboot's own.
#[test]
fn stops_have_numbers() {
    for (number, stop) in [(1, Stop::Breakpoint), (0x80, Stop::Step), (0x81, Stop::OutOfReach)] {
        assert_eq!(Stop::from_number(number), Some(stop));
    }
    assert_eq!((Stop::from_number(0), Stop::from_number(2)), (None, None));
}

#[test]
fn addresses_and_codes_are_printed_as_the_documents_write_them() {
    assert_eq!(format!("{:?}", AbortCode(0x0602_0000)), "AbortCode(06020000h)");
    assert!(format!("{}", Address::new(0x1F50, 1)).contains("1F50"));
    assert!(format!("{}", NodeId::new(42).unwrap()).contains("42"));
    assert_eq!(format!("{}", CobId::new(0x85).unwrap()), "085h");
}

/// The counter starts again after 2^32 ms; half of that is the future, and half the past.
#[test]
fn a_deadline_lies_ahead_for_half_the_range_of_the_counter() {
    for (now, deadline, has_passed) in [
        (0, 0, true),
        (0, 1, false),
        (0x7FFF_FFFF, 0, true),
        (0x8000_0000, 0, false),
        (0, 0x8000_0001, true),
        (5, 0xFFFF_FFFF, true),
    ] {
        let reached = Instant::from_millis(now).has_reached(Instant::from_millis(deadline));
        assert_eq!(reached, has_passed, "{now:#x}, {deadline:#x}");
    }
}

/// A device with a table and no more: 06010000h for what it does not implement.
struct Least;

impl Objects for Least {
    fn entries(&self) -> &'static [Entry] {
        const { &[Entry::var(0x2000, "Domain", DataType::Domain, Access::Rw)] }
    }

    fn read(&mut self, _: Address, _: &mut [u8]) -> Result<usize, AbortCode> {
        Err(AbortCode::NO_OBJECT)
    }
}

#[test]
fn what_a_device_does_not_implement_is_refused() {
    let at = Address::new(0x2000, 0);
    let refused = AbortCode(0x0601_0000);
    assert!(!Least::has_second_server());
    assert_eq!(Least.write(at, &[0]), Err(refused));
    assert_eq!(Least.download_start(at, None), Err(refused));
    assert_eq!(Least.download_data(at, &[0]), Err(refused));
    assert_eq!(Least.upload_start(at), Err(refused));
    assert_eq!(Least.upload_data(at, 0, &mut [0; 8]), Err(refused));
    assert_eq!(Least.download_space(at, false), usize::MAX);
}
