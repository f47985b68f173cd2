//! The command line of coflash.
#![forbid(unsafe_code)]

fn main() -> std::process::ExitCode {
    coflash::cli::main()
}
