//! The pins of the CAN controllers: a program that sends is heard if it has set up pins that the package
//! has.

use emulator::world::{PortId, World};
use shared_abi::geometry::{Geometry, STM32F407IG, STM32F412CG};

use super::*;

const MODER: u32 = 0x00;
const AFRL: u32 = 0x20;

/// A world with a port of 500 kbit/s and a machine whose program sends 123h on CAN1, its pins being these:
/// port, number, alternate function.
fn sender(chip: &'static Geometry, pins: &[(char, u32, u32)]) -> (World, PortId, Vec<String>) {
    let mut machine = Machine::new(chip, Options::default()).unwrap();
    load(&mut machine, &programs::TO_RAM);
    machine.power_on(Time(0));
    let script = &programs::WRITES_AND_WAITS;
    machine.write_ram(script.base, &script.code).unwrap();
    // RCC: all ports, CAN1.
    let mut stores = vec![(0x4002_3830, 0x1FF), (0x4002_3840, 1 << 25)];
    for port in 'A'..='I' {
        let base = 0x4002_0000 + 0x400 * (port as u32 - 'A' as u32);
        let of_port = || pins.iter().filter(|pin| pin.0 == port);
        let moder = of_port().fold(0, |word, &(_, pin, _)| word | 2 << (2 * pin));
        let afr = |high: u32| {
            of_port()
                .filter(|pin| pin.1 / 8 == high)
                .fold(0, |word, &(_, pin, function)| word | function << (4 * (pin % 8)))
        };
        if moder != 0 {
            stores.extend([(base + MODER, moder), (base + AFRL, afr(0)), (base + AFRL + 4, afr(1))]);
        }
    }
    // Initialisation, 500 kbit/s from 16 MHz (2 x 16), normal mode, TXRQ.
    let can = 0x4000_6400;
    stores.extend([(can, 1), (can + 0x1C, 0x001C_0001), (can, 0), (can + 0x180, 0x123 << 21 | 1)]);
    let script = stores.into_iter().flat_map(|(address, value)| [address, value]);
    let script = script.chain([0, 0, NO_CONDITION.0, NO_CONDITION.1, NO_CONDITION.2]);
    for (n, value) in (0..).zip(script) {
        put(&mut machine, ARGUMENT + 4 * n, value);
    }
    put(&mut machine, 0x2000_0000, 0);
    let mut world = World::new();
    let id = world.add_machine(machine);
    let port = world.add_host_port(500_000);
    // The program waits for its script to be complete.
    put(world.machine_mut(id), 0x2000_0200, 1);
    world.run_until(ms(20));
    let reports = world.machine(id).reports().iter().map(|report| report.what.clone()).collect();
    (world, port, reports)
}

/// Datasheets, alternate function mapping and pin definitions.
#[test]
fn who_sends_on_pins_of_its_package_is_heard() {
    const PD: [(char, u32, u32); 2] = [('D', 0, 9), ('D', 1, 9)];
    const PI_PH: [(char, u32, u32); 2] = [('I', 9, 9), ('H', 13, 9)];
    const PA: [(char, u32, u32); 2] = [('A', 11, 9), ('A', 12, 9)];
    for (chip, pins, is_heard) in [
        (&STM32F407VG, &PD[..], true),
        (&STM32F407VG, &PI_PH, false),
        (&STM32F407IG, &PI_PH, true),
        (&STM32F412CG, &PA, true),
        (&STM32F412CG, &PD, false),
        (&STM32F407VG, &PD[..1], false),
        (&STM32F407VG, &[('D', 0, 9), ('D', 1, 7)], false),
        (&STM32F407VG, &[], false),
    ] {
        let (mut world, port, reports) = sender(chip, pins);
        let heard = world.receive(port).map(|(_, frame)| frame.to_string());
        assert_eq!(heard.as_deref(), is_heard.then_some("123#"), "{}, {pins:?}: {reports:?}", chip.chip);
        let reported = reports.iter().any(|what| what.contains("no pin of this package has its"));
        assert_eq!(reported, !is_heard, "{reports:?}");
    }
}
