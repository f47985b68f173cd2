//! Compares the recorded windows of the README with today's output of `coflash`.

use std::process::Command;
use std::{env, fs};

use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use kit::folder::Folder;

const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/pictures/two-windows.txt");

/// The parts of the text that are the same for all builds and runs: all words with a digit (sizes,
/// CRCs, times) become the same word, and all lines of progress become one.
fn lasting(text: &str) -> Vec<String> {
    let is_progress = |line: &&str| line.contains(" % ") || line.trim() == "…";
    let word = |word: &str| {
        let varies = word.bytes().any(|byte| byte.is_ascii_digit());
        if varies { "#" } else { word }.to_owned()
    };
    let words = |line: &str| line.split_whitespace().map(word).collect::<Vec<_>>().join(" ");
    text.lines().filter(|line| !is_progress(line)).map(words).collect()
}

#[test]
fn the_recorded_update_is_what_the_tool_prints() {
    let text = fs::read_to_string(RECORDING).unwrap();
    let calls: Vec<&str> = text.split("$ coflash ").skip(1).collect();
    assert_eq!(calls.len(), 3);

    let coflash = env::var("COBOOT_COFLASH").expect("COBOOT_COFLASH; cargo xtask test sets it");
    let images = env::var("COBOOT_FIRMWARE_DIR").expect("COBOOT_FIRMWARE_DIR; cargo xtask test sets it");
    let bench = Bench::new().switched_on();
    let mut endpoint = Endpoint::new(bench);
    // The tool runs in real time: on a busy host an answer may come late, and a block that is sent again is
    // no part of the recording.
    let folder = Folder::below(env::temp_dir(), "coboot-recording");
    let patient = folder.join("coflash.toml");
    fs::write(&patient, "sdo-timeout = 10000\n").unwrap();
    for call in calls {
        let (line, recorded) = call.split_once('\n').unwrap();
        let mut command = Command::new(&coflash);
        command.args(line.split(' ')).env("COFLASH_BUS", endpoint.url()).current_dir(&images);
        command.env("COFLASH_CONFIG", &patient);
        let output = endpoint.run(&mut command);
        let printed = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(
            lasting(recorded),
            lasting(&printed),
            "{line}: change docs/pictures/two-windows.txt and .svg"
        );
    }
}
