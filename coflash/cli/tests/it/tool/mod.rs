//! The tool as a separate process.

pub mod kernel;

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use kit::fake::{Blocks, Fake, BOOTLOADER};
use kit::folder::Folder;

/// A device without long delays.
pub fn quick(running: u32) -> Fake {
    let mut fake = Fake::new(running);
    fake.erase_time = Duration::from_millis(30);
    fake.restart_time = Duration::from_millis(20);
    fake
}

/// A bootloader that takes block transfers.
pub fn bootloader() -> Fake {
    let mut fake = quick(BOOTLOADER);
    fake.knows_blocks = Blocks::Known(127);
    fake
}

pub struct Done {
    pub exit: i32,
    pub out: String,
    pub err: String,
}

impl Done {
    /// Checks that the command has succeeded.
    #[track_caller]
    pub fn good(self) -> Self {
        assert_eq!(self.exit, 0, "{}{}", self.out, self.err);
        self
    }

    /// Checks that the command has failed with this exit code and all these words.
    #[track_caller]
    pub fn fails(&self, exit: i32, words: &[&str]) {
        let Self { out, err, .. } = self;
        let missing: Vec<&&str> = words.iter().filter(|words| !err.contains(**words)).collect();
        assert!(
            self.exit == exit && missing.is_empty(),
            "{} and not {exit}, {missing:?}: {out}{err}",
            self.exit
        );
    }
}

/// The tool without the settings, the adapters and the locks of the user who runs the tests.
pub fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_coflash"));
    // No test makes this folder. Without a folder for locks there are none: two tests may use the
    // same name of an adapter at the same time.
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR")).join("nowhere");
    for name in ["XDG_CONFIG_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR"] {
        // A state folder is made at once.
        command.env(name, nowhere.join(name));
    }
    command.env_remove("COFLASH_BUS").env_remove("COFLASH_CONFIG");
    command.env("COFLASH_SEARCH", "none").env("NO_COLOR", "1");
    command
}

pub fn coflash(arguments: &[&str]) -> Done {
    run(command().args(arguments))
}

/// Runs the tool with the words of a line, none of which has a blank in it.
pub fn typed(line: &str) -> Done {
    run(command().args(line.split(' ')))
}

pub fn run(command: &mut Command) -> Done {
    let done = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Done { exit: done.status.code().expect("no signal"), out: text(done.stdout), err: text(done.stderr) }
}

pub fn data(name: &str) -> String {
    format!("{}/../core/tests/data/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Compares with `tests/snapshots/NAME.txt`, which a person has read and approved. With
/// `COFLASH_BLESS` in the environment the file is written instead.
#[track_caller]
pub fn snapshot(name: &str, found: &str) {
    let path = format!("{}/tests/snapshots/{name}.txt", env!("CARGO_MANIFEST_DIR"));
    if std::env::var_os("COFLASH_BLESS").is_some() {
        fs::write(&path, found).unwrap();
    }
    let expected = fs::read_to_string(&path).unwrap_or_default();
    assert!(found == expected, "{path} says\n{expected}\nand now it is\n{found}");
}

/// A folder of one test, deleted at its end.
pub fn folder(test: &str) -> Folder {
    Folder::below(env!("CARGO_TARGET_TMPDIR"), test)
}
