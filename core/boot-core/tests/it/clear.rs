//! The effect of CLEAR, and the value of 1F57h while the flash still does discarded work.

use canopen::AbortCode;
use kit::bench::{CLEAR, CLR_SIGNATURE};
use kit::model::{until_power_cut, Cut};
use kit::rig::{block, blocks, hex, raw, words, Rig, AT_ONCE_2, STANDARD_1, STANDARD_2};
use shared_abi::geometry::Region;

/// No sector.
const NONE: [u32; 0] = [];
const BUSY: u32 = 1;
const MAN_BUSY: AbortCode = AbortCode(0x0800_0022);

/// The sectors of a program that were erased since the last call, by their addresses, each once.
fn erased(rig: &Rig, number: u8) -> Vec<u32> {
    let region = rig.setup.region(number);
    let touched = std::mem::take(&mut rig.chip.model().touched);
    let of_program = |at: &Region| region.contains(at.base, at.size) && at.size > 4;
    let sectors: Vec<u32> = touched.into_iter().filter(of_program).map(|at| at.base).collect();
    assert!(sectors.is_sorted_by(|a, b| a < b), "{sectors:x?}");
    sectors
}

/// The sectors of the first `bytes` bytes of program 1 of the model: one of 400h bytes at 800h,
/// then sectors of 800h bytes (from the F407's 64 and 128 KiB).
fn sectors(bytes: u32) -> Vec<u32> {
    let all = [0x0800_0800, 0x0800_0C00, 0x0800_1400, 0x0800_1C00, 0x0800_2400, 0x0800_2C00, 0x0800_3400];
    let all = all.into_iter().chain([0x0800_3C00]);
    all.filter(|base| *base < 0x0800_0800 + bytes).collect()
}

/// CLEAR twice; returns the erased sectors.
fn clear(rig: &mut Rig, number: u8) -> Vec<u32> {
    rig.chip.model().touched.clear();
    for _ in 0..2 {
        rig.work(number, CLEAR);
        assert_eq!(rig.status(number), 0);
    }
    assert!(rig.cells(number).iter().all(|byte| *byte == 0xFF), "something is left");
    erased(rig, number)
}

#[test]
fn a_second_clear_erases_what_was_written_since_the_last_one() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    assert_eq!(clear(&mut rig, 1), NONE, "a new device");
    rig.install(1, &raw(&STANDARD_1, 1, 100));
    assert_eq!(clear(&mut rig, 1), sectors(100));
    assert_eq!(clear(&mut rig, 1), NONE);
    // Across resets.
    rig.install(1, &raw(&STANDARD_1, 1, 3000));
    rig.reset();
    assert_eq!(clear(&mut rig, 1), sectors(3000));
    rig.reset();
    assert_eq!(clear(&mut rig, 1), NONE);
    // After a smaller program, the rest of the larger one is still in flash; released and
    // confirmed.
    rig.install(1, &raw(&STANDARD_1, 1, 5000));
    rig.install(1, &raw(&STANDARD_1, 1, 600));
    rig.work(1, 0x83);
    rig.reset();
    assert_eq!(clear(&mut rig, 1), sectors(5000));
    // Another command between them is no download.
    rig.install(1, &raw(&STANDARD_1, 1, 100));
    erased(&rig, 1);
    for command in [CLEAR, CLR_SIGNATURE, CLEAR] {
        rig.work(1, command);
    }
    assert_eq!(erased(&rig, 1), sectors(100));
    // Sectors that were erased for the program, but not written, are still erased.
    let mut holey = raw(&STANDARD_1, 1, 9000);
    holey[1000..].fill(0xFF);
    rig.install(1, &holey);
    assert_eq!(clear(&mut rig, 1), sectors(1000));
    assert_eq!(clear(&mut rig, 1), NONE);
    // A debugger has written something to the last sector.
    rig.chip.model().poke(0x0800_43FC, &[0x7F]);
    rig.reset();
    assert_eq!(clear(&mut rig, 1), [0x0800_3C00]);
    // An aborted download may have left more than the contents show, also after a program that was
    // installed since.
    let image = raw(&STANDARD_1, 1, 3000);
    for installed_since in [false, true] {
        rig.clear(1);
        rig.begin(1, Some(3000), &image[..2500]).unwrap();
        rig.steps(60);
        rig.reset();
        if installed_since {
            rig.install(1, &raw(&STANDARD_1, 1, 100));
            rig.reset();
        }
        assert_eq!(clear(&mut rig, 1), sectors(0x3C00));
        assert_eq!(clear(&mut rig, 1), NONE);
    }
}

/// The same if CLEAR erases at once, and with a second program, which stays.
#[test]
fn every_clear_that_erases_does_so() {
    let mut rig = Rig::new(&STANDARD_2, 1024);
    rig.install(1, &raw(&STANDARD_2, 1, 1500));
    rig.install(2, &raw(&STANDARD_2, 2, 1500));
    assert_eq!(clear(&mut rig, 2), [0x0800_2400]);
    assert_eq!((rig.state(1), rig.state(2)), (0, 3));
    assert_eq!(clear(&mut rig, 2), NONE);
    assert_eq!(clear(&mut rig, 1), sectors(1500));
    let mut rig = Rig::new(&AT_ONCE_2, 1024);
    rig.install(1, &raw(&STANDARD_2, 1, 1500));
    rig.chip.model().touched.clear();
    rig.command(1, CLEAR).unwrap();
    assert_eq!(rig.status(1) & BUSY, BUSY);
    rig.settle();
    assert_eq!(erased(&rig, 1), sectors(1500));
    rig.clear(1);
    assert_eq!(erased(&rig, 1), NONE);
}

/// Lely's master and others send data right after the acknowledgement of CLEAR: they are taken, whatever it has to
/// do. It erases everything beside them, and a CLEAR of what is blank is done.
#[test]
fn data_right_after_clear_are_taken() {
    for setup in [&STANDARD_1, &STANDARD_2, &AT_ONCE_2] {
        let (number, base) = (setup.programs(), setup.region(setup.programs()).base);
        let image = raw(setup, number, 1200);
        let mut blocks = blocks(base, &image);
        blocks[0] = block(0, 0, &words(&[1200, 0, 0]));
        for file in [vec![image.clone()], vec![hex(base, &image)], blocks.to_vec()] {
            // What was installed, the number of CLEARs, and the steps after the last one.
            for (was, clears, steps) in
                [(0, 3, 0), (0, 3, 4), (0, 5, 0), (3000, 2, 0), (3000, 2, 60), (3000, 2, 4000), (1500, 1, 3)]
            {
                let what = format!("{}: {was} bytes, {clears} times CLEAR, {steps} steps", setup.name);
                let mut rig = Rig::new(setup, 4096);
                if was > 0 {
                    rig.install(number, &raw(setup, number, was));
                    rig.reset();
                }
                for _ in 0..clears {
                    rig.settle();
                    rig.command(number, CLEAR).unwrap();
                }
                assert!(clears <= 2 || rig.status(number) == 0, "{what}: it is done");
                rig.steps(steps);
                for (part, bytes) in file.iter().enumerate() {
                    assert_eq!(rig.send(number, bytes), Ok(()), "{what}");
                    // The queue has room for one block of data.
                    if part > 0 || file.len() == 1 {
                        rig.settle();
                    }
                }
                let cells = rig.cells(number);
                let rest_is_blank = cells[image.len()..].iter().all(|byte| *byte == 0xFF);
                assert!(rest_is_blank || clears == 1, "{what}");
                rig.assert_installed(number, &image, &what);
            }
        }
    }
}

/// The refusal of a download or of a CLEAR ends the row of CLEARs.
#[test]
fn a_refusal_ends_the_row_of_clears() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.install(1, &raw(&STANDARD_1, 1, 1500));
    for _ in 0..3 {
        rig.clear(1);
        assert!(rig.send(1, &[0; 8]).is_err());
        assert_eq!(rig.state(1), 0, "the program stays");
    }
}

/// The task that answers the bus waits for a step.
#[test]
fn to_look_for_what_is_written_takes_many_small_steps() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    for _ in 0..2 {
        rig.command(1, CLEAR).unwrap();
        loop {
            rig.chip.model().bytes_read.set(0);
            if rig.node.is_idle_after_step() {
                break;
            }
            // A step of the CRC is as long, and the journal of the model has 512 bytes.
            let read = rig.chip.model().bytes_read.get();
            assert!(read <= 1024 + 512, "{read} bytes in one step");
        }
    }
}

/// The power is cut in any operation of a CLEAR or of a large program's download. Then a small program is
/// installed or not, and removed by two CLEARs: all of the flash is erased completely.
#[test]
fn after_a_power_cut_a_second_clear_leaves_nothing_half_erased() {
    let mut cuts = 0;
    for small in [false, true] {
        for seed in 0..12 {
            let cut = if seed % 2 == 0 { Cut::Unstable(seed / 2) } else { Cut::Torn(seed / 2) };
            // Erase operations occur between some hundred words.
            for number in (1..).step_by(7) {
                let mut rig = Rig::new(&STANDARD_1, 1024);
                rig.install(1, &raw(&STANDARD_1, 1, 9000));
                rig.chip.model().power_on();
                rig.reset();
                rig.chip.model().cut = Some((number, cut));
                let was_cut = until_power_cut(|| {
                    rig.clear(1);
                    if seed < 8 {
                        rig.command(1, CLEAR).unwrap();
                    }
                    // Also beside a CLEAR that erases.
                    if seed >= 4 {
                        rig.send(1, &raw(&STANDARD_1, 1, 8000)).unwrap();
                    }
                    rig.settle();
                });
                if !was_cut {
                    break;
                }
                cuts += 1;
                rig.reset();
                if small {
                    rig.install(1, &raw(&STANDARD_1, 1, 100));
                    rig.reset();
                }
                clear(&mut rig, 1);
                assert!(rig.chip.model().is_stable(STANDARD_1.region(1)), "{cut:?} in operation {number}");
                rig.reset();
                assert_eq!(clear(&mut rig, 1), NONE);
            }
        }
    }
    assert!(cuts > 200, "{cuts}");
}

/// An aborted raw image leaves a running erase, and records that are being stored. While a command
/// is refused for this reason, the status is busy.
#[test]
fn a_command_is_refused_as_untimely_only_while_the_status_says_busy() {
    for setup in [&STANDARD_1, &STANDARD_2] {
        for sent in [8, 700, 1100, 2100] {
            for steps in 0..120 {
                for command in [0x01, 0x02, 0x83, 0x84] {
                    let mut rig = Rig::new(setup, 4096);
                    rig.install(1, &raw(setup, 1, 3000));
                    rig.clear(1);
                    rig.begin(1, Some(3000), &raw(setup, 1, 3000)[..sent]).unwrap();
                    rig.steps(steps);
                    rig.cancel(1);
                    // Program 2 must wait for the same flash.
                    let number = setup.programs();
                    let busy = rig.status(number) & BUSY != 0;
                    let taken = rig.command(number, command);
                    let expected = if busy { Err(MAN_BUSY) } else { Ok(()) };
                    assert_eq!(taken, expected, "{command:02X} for {number}, {sent} sent, {steps} steps");
                    rig.settle();
                    assert_eq!(rig.status(1) & BUSY, 0);
                }
            }
        }
    }
}
