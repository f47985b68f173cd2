//! Proof by power cut for sealed images: at every flash operation of a scenario, in every way, and
//! again in the recovery. Afterwards there is the old program, none, or the new one, complete; the
//! counter never decreases; and a repetition succeeds.

use coboot_tests::sealed::{image, seal, sealer, Device, Host, Setup, CONFIRMED_1, STANDARD_1, STANDARD_2};
use coflash_core::file::sealed::Sealer;
use kit::model::{until_power_cut, Cut, ModelFlash};
use kit::rig::fill_journal;
use shared_abi::geometry::Region;

/// The number of checks: bits between 0 and 1 read differently each time.
const LOOKS: usize = 3;
const CUTS: [Cut; 6] =
    [Cut::Before, Cut::After, Cut::Torn(7), Cut::Torn(8), Cut::Unstable(7), Cut::Unstable(8)];

/// An image of program 1 and its file.
struct Made {
    image: Vec<u8>,
    file: Vec<u8>,
    counter: u32,
}

fn made(setup: &Setup, form: (bool, bool), len: usize, seed: u8, counter: u32) -> Made {
    let image = image(setup.region(1), len, seed);
    let sealer = Sealer { chunk: 9, counter, version: seed.into(), ..sealer(form) };
    Made { file: seal(&sealer, &image), image, counter }
}

/// The actions on a device with `old` in it (or nothing), their result, and the permitted states.
struct Story<'a> {
    before: Device,
    old: Option<&'a Made>,
    new: Option<&'a Made>,
    act: &'a dyn Fn(&mut Host<'_>),
    /// Whether the counter is raised at the confirmation of the program.
    with_confirmation: bool,
}

/// The state that was found.
#[derive(Default, Debug)]
struct Seen {
    points: u32,
    old: u32,
    new: u32,
    none: u32,
    /// The new counter with the old program or none.
    raised_first: u32,
}

impl<'a> Story<'a> {
    /// An update.
    fn update(before: Device, old: Option<&'a Made>, new: &'a Made, act: &'a dyn Fn(&mut Host<'_>)) -> Self {
        Self { before, old, new: Some(new), act, with_confirmation: false }
    }

    /// The properties at any time; `floor` is the previous counter. With a bit between 0 and 1, the
    /// new counter may read as if it were stored: it only counts after its program is stored.
    fn look(&self, device: &Device, floor: u32, seen: &mut Seen, told: &str) -> u32 {
        let mut lowest = u32::MAX;
        let news = seen.new;
        for _ in 0..LOOKS {
            let counter = device.counter(1);
            lowest = lowest.min(counter);
            assert!(counter >= floor, "{told}: the counter went back from {floor} to {counter}");
            let is = |made: Option<&Made>| {
                made.is_some_and(|made| device.cells(1, made.image.len()) == made.image)
            };
            let verified = device.verified(1);
            let new = verified.is_ok() && is(self.new);
            match verified {
                Ok(_) if new => seen.new += 1,
                Ok(_) if is(self.old) => seen.old += 1,
                Ok(_) => panic!("{told}: a program would start that is neither"),
                Err(_) => seen.none += 1,
            }
            // Again: a bit of the record may be between 0 and 1.
            let starts = device.starts(None).is_none() || is(self.new) || is(self.old);
            assert!(starts, "{told}: a program would start that is neither");
            if let (true, Some(made), false) = (new, self.new, self.with_confirmation) {
                assert!(counter >= made.counter, "{told}: the program is there before its counter");
            }
            let raised = self.new.is_some_and(|made| counter == made.counter);
            if !new && raised && self.old.is_none_or(|old| old.counter < counter) {
                seen.raised_first += 1;
            }
            // A valid record matches the flash.
            if let Some(record) = device.record(1) {
                let place = Region::new(device.setup.region(1).base, record.size);
                let cells = device.chip.model().cells(place).to_vec();
                assert_eq!(coboot_tests::sealed::crc32(&cells), record.crc, "{told}");
                assert!(device.chip.model().is_stable(place), "{told}");
            }
        }
        let stable = seen.new == news + LOOKS as u32 || !told.contains("Unstable");
        if stable && !self.with_confirmation {
            lowest
        } else {
            floor
        }
    }

    /// Runs it on a copy of this flash with a cut; returns the device without power, and whether
    /// the cut occurred.
    fn cut(&self, flash: &ModelFlash, at: Option<(u32, Cut)>) -> (Device, bool) {
        let mut flash = flash.clone();
        flash.power_on();
        flash.touched.clear();
        flash.cut = at;
        let device = Device::on(self.before.setup, flash);
        let struck = until_power_cut(|| device.run(|host| (self.act)(host)));
        device.chip.model().power_on();
        (device, struck)
    }

    fn ends(&self, flash: &ModelFlash, told: &str) -> u32 {
        let (device, _) = self.cut(flash, None);
        let operations = device.chip.model().touched.len() as u32;
        match self.new {
            Some(made) => assert!(device.holds(1, &made.image), "{told}"),
            None => assert!(device.record(1).is_none(), "{told}"),
        }
        if let Some(made) = self.new {
            assert_eq!(device.counter(1).max(made.counter), made.counter, "{told}");
            if !self.with_confirmation {
                assert_eq!(device.counter(1), made.counter, "{told}");
            }
        }
        operations
    }

    fn prove(&self, name: &str) -> Seen {
        let mut seen = Seen::default();
        let start = self.before.chip.model().clone();
        let floor = self.before.counter(1);
        let operations = self.ends(&start, name);
        for operation in 1..=operations {
            for (kind, cut) in CUTS.into_iter().enumerate() {
                let told = format!("{name}: {cut:?} at operation {operation} of {operations}");
                let (device, struck) = self.cut(&start, Some((operation, cut)));
                assert!(struck, "{told}");
                seen.points += 1;
                let floor = self.look(&device, floor, &mut seen, &told);
                let after = device.chip.model().clone();
                let rest = self.ends(&after, &told);
                // And again, at an operation of the second attempt that differs from point to
                // point.
                if rest > 0 {
                    let second = 1 + (operation * 7 + kind as u32 * 13) % rest;
                    let cut = CUTS[(kind + 3) % CUTS.len()];
                    let told = format!("{told}, then {cut:?} at operation {second}");
                    let (device, _) = self.cut(&after, Some((second, cut)));
                    seen.points += 1;
                    self.look(&device, floor, &mut seen, &told);
                    let after = device.chip.model().clone();
                    self.ends(&after, &told);
                }
            }
        }
        println!("{name}: {operations} operations, {seen:?}");
        assert!(seen.points >= 6 * operations, "{seen:?}");
        seen
    }
}

/// A device with this program.
fn with(setup: &'static Setup, made: Option<&Made>) -> Device {
    let device = Device::sealed(setup);
    if let Some(made) = made {
        device.run(|host| host.install(1, &made.file));
    }
    device.take_touched();
    device
}

#[test]
fn an_update_leaves_the_old_program_none_or_the_new_one() {
    for (form, len) in [((false, false), 560), ((true, true), 900)] {
        let old = made(&STANDARD_1, (false, false), 600, 0xA3, 5);
        let new = made(&STANDARD_1, form, len, 0xB7, 7);
        let seen = Story::update(with(&STANDARD_1, Some(&old)), Some(&old), &new, &|host| {
            host.install(1, &new.file)
        })
        .prove("update");
        assert!(seen.old > 0 && seen.new > 0 && seen.none > 0 && seen.raised_first > 0, "{seen:?}");
    }
}

/// Often enough that the journal changes to its other region meanwhile, wherever it was before.
#[test]
fn and_while_the_journal_changes_over() {
    let old = made(&STANDARD_2, (false, false), 64, 0xA3, 5);
    let new = made(&STANDARD_2, (true, false), 64, 0xB7, 7);
    let mut changed = 0;
    for stores in 0..22 {
        let before = with(&STANDARD_2, Some(&old));
        before.run(|host| {
            host.commanded(1, 0x83);
        });
        fill_journal(&mut before.chip.clone(), STANDARD_2.layout, stores);
        before.take_touched();
        let through = before.copy();
        through.run(|host| host.install(1, &new.file));
        let journal = STANDARD_2.layout.parameters;
        let moves = |region: &Region| region.size > 4 && journal.contains(region);
        if !through.chip.model().touched.iter().any(moves) {
            continue;
        }
        changed += 1;
        if changed > 3 {
            continue;
        }
        Story::update(before, Some(&old), &new, &|host| host.install(1, &new.file)).prove("changing over");
    }
    assert!(changed > 2, "{changed}");
}

#[test]
fn a_first_image_leaves_none_or_all() {
    let new = made(&STANDARD_1, (true, true), 560, 0xB7, 7);
    let seen = Story::update(with(&STANDARD_1, None), None, &new, &|host| host.install(1, &new.file))
        .prove("first image");
    assert!(seen.new > 0 && seen.none > 0 && seen.raised_first > 0 && seen.old == 0, "{seen:?}");
}

#[test]
fn the_same_image_again_can_be_cut_anywhere() {
    let same = made(&STANDARD_1, (true, true), 560, 0xB7, 7);
    let seen = Story::update(with(&STANDARD_1, Some(&same)), Some(&same), &same, &|host| {
        host.install(1, &same.file)
    })
    .prove("same image");
    assert_eq!((seen.none, seen.old), (0, 0), "{seen:?}");
}

/// The previous program has proved itself: its counter stays, whatever the result of the update.
#[test]
fn with_confirmation_a_proved_counter_stays() {
    let old = made(&CONFIRMED_1, (false, false), 300, 0xA3, 5);
    let new = made(&CONFIRMED_1, (true, true), 300, 0xB7, 7);
    let confirmed = || {
        let device = with(&CONFIRMED_1, Some(&old));
        device.run(|host| host.confirm(1));
        device.take_touched();
        device
    };
    let older = made(&CONFIRMED_1, (false, false), 64, 0xC1, 4);
    // A program older than the proved one is refused at every point, whatever the store contains.
    let refused = |device: &Device, told: &str| {
        let device = device.copy();
        device.run(|host| assert_eq!(host.update(1, &older.file, 7).1, 0x8C, "{told}"));
    };
    let update = |host: &mut Host<'_>| host.install(1, &new.file);
    let erase = |host: &mut Host<'_>| host.erase(1);
    let update_and_confirm = |host: &mut Host<'_>| {
        host.install(1, &new.file);
        host.confirm(1);
    };
    type Act<'a> = &'a dyn Fn(&mut Host<'_>);
    let stories: [(&str, Act<'_>, Option<&Made>); 3] = [
        ("update of a proved program", &update, Some(&new)),
        ("erasing a proved program", &erase, None),
        ("update and confirmation", &update_and_confirm, Some(&new)),
    ];
    for (name, act, new) in stories {
        let before = confirmed();
        let start = before.chip.model().clone();
        let story = Story { before, old: Some(&old), new, act, with_confirmation: true };
        story.prove(name);
        let operations = story.ends(&start, name);
        for operation in 1..=operations {
            let cut = CUTS[operation as usize % CUTS.len()];
            let (device, _) = story.cut(&start, Some((operation, cut)));
            refused(&device, &format!("{name}: {cut:?} at {operation}"));
        }
        let (device, _) = story.cut(&start, None);
        refused(&device, name);
    }
}
