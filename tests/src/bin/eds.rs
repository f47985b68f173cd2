//! Writes the EDS files to a folder: `cargo xtask eds`.

use std::path::Path;
use std::process::ExitCode;
use std::{env, fs};

use coboot_tests::eds;

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [folder] = &arguments[..] else {
        eprintln!("usage: eds FOLDER");
        return ExitCode::from(2);
    };
    for image in eds::images() {
        let path = Path::new(folder).join(image.file);
        if let Err(error) = fs::write(&path, image.eds()) {
            eprintln!("{}: {error}", path.display());
            return ExitCode::FAILURE;
        }
        println!("{}: {} objects", path.display(), image.indices().len());
    }
    ExitCode::SUCCESS
}
