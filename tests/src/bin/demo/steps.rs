//! The steps that the stories share, and how they are printed.

use canopen::program::{DEVICE_NAME, PROGRAM_ID, SOFTWARE_VERSION};
use canopen::Address;
use coboot_tests::bench::Bench;
use coboot_tests::firmware;
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::Program;
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::time::Time;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// What went well, or why not.
pub type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

/// Begins a part of the story.
pub fn chapter(title: &str) {
    println!("\n{title}");
}

/// Prints what happened at this time.
pub fn print_line(at: Time, what: &str) {
    println!("  {:>9.3} s  {what}", at.0 as f64 / 1e12);
}

/// The device's information.
pub fn introduce(bench: &mut Bench) -> Outcome<()> {
    let mut session = bench.session();
    let Some(running) = session.device_type()? else { return Err("the device does not answer".into()) };
    let name = session.read_text(Address::new(DEVICE_NAME, 0))?;
    let version = session.read_text(Address::new(SOFTWARE_VERSION, 0))?;
    let crc = session.read_number(Address::new(PROGRAM_ID, 1))?;
    let what = if running.is_bootloader() { "the bootloader answers" } else { "the application answers" };
    print_line(bench.time(), &format!("{what}: \"{name}\", version \"{version}\", program CRC {crc:08X}h"));
    Ok(())
}

/// An application's ELF file as the blocks for the device.
pub fn convert(image: &str) -> Program {
    let file = firmware::blocks(image);
    let (size, crc) = (file.size(), file.crc());
    println!(
        "               {image} converted: {size} bytes in {} blocks, CRC {crc:08X}h",
        BlockFile::of(&file).blocks().len()
    );
    file
}

/// The whole procedure, printed step by step.
pub fn install(bench: &mut Bench, file: &Program) -> Outcome<()> {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stdout());
    // The rate and the remaining time use the wall clock.
    let style = ProgressStyle::with_template(
        "               {bar:36} {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left",
    )?;
    bar.set_style(style.progress_chars("=> "));
    let clock = bench.clock();
    let mut complete = false;
    let outcome = flash(&mut bench.session(), file, &FlashOptions::default(), &mut |event| match event {
        Event::Progress { done, total } => {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            if done == total && !complete {
                complete = true;
                bar.finish();
                print_line(clock.get(), &format!("all {total} bytes are in the device"));
            }
        }
        // The report below shows the end.
        Event::Done(_) => {}
        event => print_line(clock.get(), &event.to_string()),
    });
    let report = outcome?;
    let rate = f64::from(report.program_size) / report.took.as_secs_f64() / 1024.0;
    print_line(
        bench.time(),
        &format!("the update took {:.1} s on the bus ({rate:.1} KiB/s)", report.took.as_secs_f64()),
    );
    Ok(())
}
