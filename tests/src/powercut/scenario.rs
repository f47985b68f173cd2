//! The actions on the device, and the permitted states after a cut at any time.

use boot_core::canopen::{BitRate, NodeId};
use boot_core::crc32;
use boot_core::store::Key;
use boot_core::store::NodeParameters;

use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE};
use kit::ihex::intel_hex;
use kit::rig::{block, words};

use super::device::{image, Bug, Device, Outcome, BOARD_NODE, LAYOUT, NEW, OLD, PRODUCT_CODE, VENDOR_ID};

const START_OLD: Outcome = Outcome::Runs(OLD);
const START_NEW: Outcome = Outcome::Runs(NEW);
const STAY: Outcome = Outcome::Bootloader;

/// The permitted states after the power returns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Allowed {
    /// The permitted behaviour of the device.
    pub outcomes: Vec<Outcome>,
    /// The permitted node-ID and bit rate.
    pub nodes: Vec<NodeParameters>,
    /// The permitted program 2: its seed, and whether it is released.
    pub second: Vec<Option<(u8, bool)>>,
}

/// The function through which a script reports its progress.
pub type Tell<'a> = &'a mut dyn FnMut(Allowed);

/// A scenario: the device before, the actions, and the actions that complete the scenario after a
/// cut.
pub struct Scenario {
    /// Its name on the command line.
    pub name: &'static str,
    /// Its description.
    pub about: &'static str,
    /// Prepares the device.
    prepare: fn(&mut Device),
    /// The actions; they report the states that are permitted from now on.
    act: fn(&mut Device, Tell<'_>) -> Result<(), String>,
    /// The host's actions after a cut, given the states that were permitted before.
    recover: fn(&mut Device, &Allowed, Tell<'_>) -> Result<(), String>,
    /// The state at the end.
    end: fn() -> Allowed,
}

impl Scenario {
    /// The prepared device.
    pub fn device(&self, bug: Option<Bug>) -> Device {
        let mut device = Device::new(bug);
        (self.prepare)(&mut device);
        device.power_on();
        device
    }

    /// Switches the power on and runs the scenario.
    ///
    /// # Errors
    /// The device's refusal.
    pub fn act(&self, device: &mut Device, _: &Allowed, tell: Tell<'_>) -> Result<(), String> {
        device.boot();
        (self.act)(device, tell)
    }

    /// Switches the power on and runs the host's actions after a cut.
    ///
    /// # Errors
    /// The device's refusal.
    pub fn recover(&self, device: &mut Device, from: &Allowed, tell: Tell<'_>) -> Result<(), String> {
        device.boot();
        (self.recover)(device, from, tell)
    }

    /// The state at the end.
    pub fn end(&self) -> Allowed {
        (self.end)()
    }
}

fn allowed(outcomes: &[Outcome]) -> Allowed {
    Allowed { outcomes: outcomes.to_vec(), nodes: vec![BOARD_NODE], second: vec![None] }
}

fn with_nodes(outcomes: &[Outcome], nodes: &[NodeParameters]) -> Allowed {
    Allowed { nodes: nodes.to_vec(), ..allowed(outcomes) }
}

fn with_second(outcomes: &[Outcome], second: &[Option<(u8, bool)>]) -> Allowed {
    Allowed { second: second.to_vec(), ..allowed(outcomes) }
}

// --- block files
// -----------------------------------------------------------------------------------------------------

/// The blocks of a program; `crc` is the CRC in the last one.
fn blocks(number: u8, image: &[u8], product_code: u32, crc: u32) -> Vec<Vec<u8>> {
    let base = LAYOUT.programs[usize::from(number) - 1].base;
    let size = image.len() as u32;
    let mut file = vec![block(0, 0, &words(&[size, VENDOR_ID, product_code]))];
    for (i, data) in (0..).zip(image.chunks(96)) {
        file.push(block(1 + i, base + 96 * i, data));
    }
    file.push(block(u32::MAX, 0, &words(&[size, crc])));
    file
}

fn good(number: u8, seed: u8) -> Vec<Vec<u8>> {
    let image = image(number, seed);
    blocks(number, &image, PRODUCT_CODE, crc32(&image))
}

/// CLEAR and the blocks. `begun` is called before the first block.
fn download(
    device: &mut Device,
    number: u8,
    file: &[Vec<u8>],
    mut begun: impl FnMut(),
) -> Result<(), String> {
    device.host(|host| {
        host.command(number, CLEAR)?;
        begun();
        file.iter().try_for_each(|block| host.block(number, block))
    })
}

fn install(device: &mut Device, number: u8, seed: u8, signed: bool) {
    download(device, number, &good(number, seed), || ()).expect("a sound device takes a good program");
    if signed {
        device.host(|host| host.command(number, SET_SIGNATURE)).expect("a sound device signs it");
    }
}

/// The new program is there, and is signed.
fn release(device: &mut Device, tell: Tell<'_>) -> Result<(), String> {
    tell(allowed(&[STAY, START_NEW]));
    device.host(|host| host.command(1, SET_SIGNATURE))?;
    tell(allowed(&[START_NEW]));
    Ok(())
}

/// An update of program 1 to the new program.
fn update(device: &mut Device, tell: Tell<'_>) -> Result<(), String> {
    download(device, 1, &good(1, NEW), || tell(allowed(&[START_OLD, STAY])))?;
    release(device, tell)
}

/// Two CLEARs.
fn erase(device: &mut Device) -> Result<(), String> {
    device.host(|host| {
        host.command(1, CLEAR)?;
        host.command(1, CLEAR)
    })
}

/// Two CLEARs, a reset, and the new program without CLEAR.
fn erase_and_install(device: &mut Device, tell: Tell<'_>) -> Result<(), String> {
    erase(device)?;
    tell(allowed(&[STAY]));
    device.host(|host| good(1, NEW).iter().try_for_each(|block| host.block(1, block)))?;
    release(device, tell)
}

/// An update of program 1 in one transfer.
fn update_at_once(device: &mut Device, data: Vec<u8>, tell: Tell<'_>) -> Result<(), String> {
    download(device, 1, &[data], || tell(allowed(&[START_OLD, STAY, START_NEW])))?;
    tell(allowed(&[START_NEW]));
    Ok(())
}

/// Arbitrary bytes, except the byte that identifies them.
fn parameter_set(seed: u8) -> Vec<u8> {
    (0..150_u8).map(|i| if i == 8 { seed } else { i.wrapping_mul(3) }).collect()
}

fn raw() -> Vec<u8> {
    image(1, NEW)
}

fn hex() -> Vec<u8> {
    intel_hex(LAYOUT.programs[0].base, &image(1, NEW)).into_bytes()
}

/// The same after a cut, in an unknown state.
fn update_after_a_cut(device: &mut Device, _: &Allowed, tell: Tell<'_>) -> Result<(), String> {
    download(device, 1, &good(1, NEW), || tell(allowed(&[START_OLD, STAY, START_NEW])))?;
    tell(allowed(&[STAY, START_NEW]));
    device.host(|host| host.command(1, SET_SIGNATURE))
}

// --- the stories
// -----------------------------------------------------------------------------------------------------

/// Of a device that has the old program, and gets the new one.
const UPDATE: Scenario = Scenario {
    name: "update",
    about: "another program in the place of one that runs",
    prepare: |device| install(device, 1, OLD, true),
    act: |device, tell| {
        tell(allowed(&[START_OLD]));
        update(device, tell)
    },
    recover: update_after_a_cut,
    end: || allowed(&[START_NEW]),
};

/// All of them.
pub const SCENARIOS: &[Scenario] = &[
    Scenario {
        name: "first-install",
        about: "a program into an empty device",
        prepare: |_| (),
        act: |device, tell| {
            tell(allowed(&[STAY]));
            download(device, 1, &good(1, NEW), || ())?;
            release(device, tell)
        },
        ..UPDATE
    },
    UPDATE,
    Scenario {
        name: "raw",
        about: "another program as a raw image, which is valid without a signature command",
        act: |device, tell| {
            tell(allowed(&[START_OLD]));
            update_at_once(device, raw(), tell)
        },
        recover: |device, _, tell| update_at_once(device, raw(), tell),
        ..UPDATE
    },
    Scenario {
        name: "hex",
        about: "another program as Intel HEX",
        act: |device, tell| {
            tell(allowed(&[START_OLD]));
            update_at_once(device, hex(), tell)
        },
        recover: |device, _, tell| update_at_once(device, hex(), tell),
        ..UPDATE
    },
    Scenario {
        name: "wrong-crc",
        about: "an update whose last block tells another CRC, then the right one",
        act: |device, tell| {
            tell(allowed(&[START_OLD]));
            let wrong = blocks(1, &image(1, NEW), PRODUCT_CODE, 0xDEAD_BEEF);
            let outcome = download(device, 1, &wrong, || tell(allowed(&[START_OLD, STAY])));
            if outcome.is_ok() {
                return Err("a program with a wrong CRC was taken".into());
            }
            tell(allowed(&[STAY]));
            if device.host(|host| host.command(1, SET_SIGNATURE)).is_ok() {
                return Err("a program with a wrong CRC was signed".into());
            }
            update(device, tell)
        },
        ..UPDATE
    },
    Scenario {
        name: "wrong-product",
        about: "an update for another product, which costs nothing",
        act: |device, tell| {
            tell(allowed(&[START_OLD]));
            let image = image(1, NEW);
            let wrong = blocks(1, &image, PRODUCT_CODE ^ 1, crc32(&image));
            match download(device, 1, &wrong, || ()) {
                Ok(()) => Err("a program for another product was taken".into()),
                Err(_) => Ok(()),
            }
        },
        end: || allowed(&[START_OLD, START_NEW]),
        ..UPDATE
    },
    Scenario {
        name: "erase",
        about: "a program taken away by two CLEARs",
        act: |device, tell| {
            tell(allowed(&[START_OLD, STAY]));
            erase(device)?;
            tell(allowed(&[STAY]));
            Ok(())
        },
        recover: |device, _, _| erase(device),
        end: || allowed(&[STAY]),
        ..UPDATE
    },
    Scenario {
        name: "erase-and-install",
        about: "a program taken away by two CLEARs, and after a reset another one without CLEAR, which looks whether the flash is blank",
        act: |device, tell| {
            tell(allowed(&[START_OLD, STAY]));
            erase_and_install(device, tell)
        },
        recover: |device, from, tell| {
            tell(from.clone());
            erase_and_install(device, tell)
        },
        ..UPDATE
    },
    Scenario {
        name: "sign",
        about: "a signature set",
        prepare: |device| install(device, 1, OLD, false),
        act: |device, tell| {
            tell(allowed(&[STAY, START_OLD]));
            device.host(|host| host.command(1, SET_SIGNATURE))?;
            tell(allowed(&[START_OLD]));
            Ok(())
        },
        recover: |device, _, _| device.host(|host| host.command(1, SET_SIGNATURE)),
        end: || allowed(&[START_OLD]),
    },
    Scenario {
        name: "unsign",
        about: "a signature taken away",
        act: |device, tell| {
            tell(allowed(&[STAY, START_OLD]));
            device.host(|host| host.command(1, CLR_SIGNATURE))?;
            tell(allowed(&[STAY]));
            Ok(())
        },
        recover: |device, _, _| device.host(|host| host.command(1, CLR_SIGNATURE)),
        end: || allowed(&[STAY]),
        ..UPDATE
    },
    Scenario {
        name: "lss-store",
        about: "node-ID and bit rate stored by layer setting services",
        act: |device, tell| {
            tell(with_nodes(&[START_OLD], &[BOARD_NODE, node(9)]));
            device.host(|host| host.store_node(node(9)))?;
            tell(with_nodes(&[START_OLD], &[node(9)]));
            Ok(())
        },
        recover: |device, _, _| device.host(|host| host.store_node(node(9))),
        end: || with_nodes(&[START_OLD], &[node(9)]),
        ..UPDATE
    },
    Scenario {
        name: "compaction",
        about: "so many stores of node-ID and bit rate that the journal changes over twice",
        act: |device, tell| {
            let mut last = BOARD_NODE;
            for id in 1..=50 {
                tell(with_nodes(&[START_OLD], &[last, node(id)]));
                device.host(|host| host.store_node(node(id)))?;
                last = node(id);
                tell(with_nodes(&[START_OLD], &[last]));
            }
            Ok(())
        },
        recover: |device, from, tell| {
            tell(Allowed { nodes: [&from.nodes[..], &[node(100)]].concat(), ..from.clone() });
            device.host(|host| host.store_node(node(100)))
        },
        end: || with_nodes(&[START_OLD], &[node(50), node(100)]),
        ..UPDATE
    },
    Scenario {
        name: "crash-count",
        about: "the count of crashes, cleared by a power-on",
        prepare: |device| {
            install(device, 1, OLD, true);
            device.store(Key::CRASH_COUNT, [2, 0, 0, 0]);
        },
        act: |_, tell| {
            tell(allowed(&[START_OLD]));
            Ok(())
        },
        recover: |_, _, _| Ok(()),
        end: || allowed(&[START_OLD]),
    },
    Scenario {
        name: "parameter-set",
        about: "another set of parameters in the place of one, in a lift",
        prepare: |device| {
            install(device, 1, OLD, true);
            device.host_of_lift(|host| host.block(2, &parameter_set(OLD))).expect("a set of parameters");
        },
        act: |device, tell| {
            tell(with_second(&[START_OLD], &[Some((OLD, true)), None, Some((NEW, true))]));
            device.host_of_lift(|host| host.block(2, &parameter_set(NEW)))?;
            tell(with_second(&[START_OLD], &[Some((NEW, true))]));
            Ok(())
        },
        recover: |device, _, _| device.host_of_lift(|host| host.block(2, &parameter_set(NEW))),
        end: || with_second(&[START_OLD], &[Some((NEW, true))]),
    },
    Scenario {
        name: "second-program",
        about: "program 2 updated while program 1 stays what it is",
        prepare: |device| {
            install(device, 1, OLD, true);
            install(device, 2, OLD, true);
        },
        act: |device, tell| {
            const OLD_THERE: Option<(u8, bool)> = Some((OLD, true));
            const UNSIGNED: Option<(u8, bool)> = Some((NEW, false));
            const NEW_THERE: Option<(u8, bool)> = Some((NEW, true));
            tell(with_second(&[START_OLD], &[OLD_THERE]));
            download(device, 2, &good(2, NEW), || {
                tell(with_second(&[START_OLD], &[OLD_THERE, None, UNSIGNED]))
            })?;
            tell(with_second(&[START_OLD], &[UNSIGNED, NEW_THERE]));
            device.host(|host| host.command(2, SET_SIGNATURE))?;
            tell(with_second(&[START_OLD], &[NEW_THERE]));
            Ok(())
        },
        recover: |device, _, tell| {
            let any = [Some((OLD, true)), None, Some((NEW, false)), Some((NEW, true))];
            download(device, 2, &good(2, NEW), || tell(with_second(&[START_OLD], &any)))?;
            device.host(|host| host.command(2, SET_SIGNATURE))
        },
        end: || with_second(&[START_OLD], &[Some((NEW, true))]),
    },
    Scenario {
        name: "beside-the-second",
        about: "program 1 updated while program 2 stays what it is",
        prepare: |device| {
            install(device, 1, OLD, true);
            install(device, 2, OLD, true);
        },
        act: |device, tell| {
            let beside = |outcomes: &[Outcome]| with_second(outcomes, &[Some((OLD, true))]);
            tell(beside(&[START_OLD]));
            update(device, &mut |now| tell(beside(&now.outcomes)))
        },
        recover: |device, from, tell| {
            let beside = |outcomes: &[Outcome]| with_second(outcomes, &[Some((OLD, true))]);
            update_after_a_cut(device, from, &mut |now| tell(beside(&now.outcomes)))
        },
        end: || with_second(&[START_NEW], &[Some((OLD, true))]),
    },
    Scenario {
        name: "lift-password-during",
        about: "a lift's password in the middle of work, and then the set of parameters broken off",
        prepare: install_in_lift,
        act: |device, tell| {
            const OLD_THERE: Option<(u8, bool)> = Some((OLD, true));
            tell(with_second(&[START_OLD], &[OLD_THERE]));
            device.host_of_locked_lift(|host| {
                host.password(1)?;
                tell(with_second(&[START_OLD, STAY], &[OLD_THERE]));
                host.broken_off(1, &raw(), 140, WORK / 2)?;
                // It may have to wait; then nothing is lost.
                if host.password(2).is_ok() {
                    tell(with_second(&[START_OLD, STAY], &[OLD_THERE, None]));
                    let _ = host.broken_off(2, &parameter_set(NEW), 140, WORK);
                }
                host.settle();
                Ok(())
            })
        },
        recover: |device, _, tell| lift_from_anything(device, tell),
        end: || with_second(&[START_NEW], &[Some((NEW, true))]),
    },
    Scenario {
        name: "password-during",
        about: "ESAcademy's passwords of two programs, one in the middle of work on the other one",
        prepare: |device| {
            for program in [1, 2] {
                esacademy(device, program, OLD).expect("a sound device takes a good program");
            }
        },
        act: |device, tell| {
            const OLD_THERE: Option<(u8, bool)> = Some((OLD, true));
            tell(with_second(&[START_OLD, STAY], &[OLD_THERE]));
            device.host_of_esacademy(|host| {
                host.password(1)?;
                host.broken_off(1, &raw(), 140, WORK / 2)?;
                if host.password(2).is_ok() {
                    tell(with_second(&[START_OLD, STAY], &[OLD_THERE, None]));
                    let _ = host.broken_off(2, &image(2, NEW), 140, WORK);
                }
                host.settle();
                Ok(())
            })
        },
        recover: |device, _, tell| esacademy_from_anything(device, tell),
        end: || with_second(&[START_NEW], &[Some((NEW, true))]),
    },
];

/// The number of steps in which a sector is erased and some words are programmed.
const WORK: u32 = 60;

fn install_in_lift(device: &mut Device) {
    let installed = device.host_of_locked_lift(|host| {
        host.password(1)?;
        host.block(1, &image(1, OLD))?;
        host.block(2, &parameter_set(OLD))
    });
    installed.expect("a sound device takes a good program");
}

/// Password, program and set of parameters, whatever the state is.
fn lift_from_anything(device: &mut Device, tell: Tell<'_>) -> Result<(), String> {
    const ANY: [Option<(u8, bool)>; 3] = [Some((OLD, true)), None, Some((NEW, true))];
    tell(with_second(&[START_OLD, STAY, START_NEW], &ANY));
    device.host_of_locked_lift(|host| {
        host.password(1)?;
        host.block(1, &raw())?;
        tell(with_second(&[START_NEW], &ANY));
        host.block(2, &parameter_set(NEW))
    })?;
    tell(with_second(&[START_NEW], &[Some((NEW, true))]));
    Ok(())
}

/// Password and program in one transfer.
fn esacademy(device: &mut Device, program: u8, seed: u8) -> Result<(), String> {
    device.host_of_esacademy(|host| {
        host.password(program)?;
        host.settle();
        host.block(program, &image(program, seed))
    })
}

/// Both programs, whatever the state is.
fn esacademy_from_anything(device: &mut Device, tell: Tell<'_>) -> Result<(), String> {
    const ANY: [Option<(u8, bool)>; 3] = [Some((OLD, true)), None, Some((NEW, true))];
    tell(with_second(&[START_OLD, STAY, START_NEW], &ANY));
    esacademy(device, 1, NEW)?;
    tell(with_second(&[START_NEW], &ANY));
    esacademy(device, 2, NEW)?;
    tell(with_second(&[START_NEW], &[Some((NEW, true))]));
    Ok(())
}

/// The node-ID and bit rate with this number.
fn node(id: u8) -> NodeParameters {
    let bit_rate = if id.is_multiple_of(2) { BitRate::K250 } else { BitRate::K500 };
    NodeParameters { id: NodeId::new(id), bit_rate }
}
