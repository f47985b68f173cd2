//! Finds a library and its functions.

use std::fmt;

use libloading::Library;

/// Why a library cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LoadError {
    /// None of its files is there, or none can be loaded.
    Missing {
        /// The file names that were looked for, in this order.
        files: Vec<String>,
        /// What the system said of the last one.
        why: String,
    },
    /// It is there, and lacks a function that is needed: an old version, or another library.
    Old {
        /// The file.
        file: String,
        /// The function.
        symbol: &'static str,
    },
}

impl fmt::Display for LoadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing { files, why } => {
                write!(f, "the library {} cannot be loaded ({why})", files.join(" or "))
            }
            Self::Old { file, symbol } => write!(f, "the library {file} has no function {symbol}"),
        }
    }
}

impl std::error::Error for LoadError {}

/// A library that is loaded, and the file that it came from.
pub(crate) struct Loaded {
    library: Library,
    file: String,
}

impl Loaded {
    /// The first of these files that loads.
    ///
    /// # Safety
    /// A library's own start-up code runs: the files must be those of the vendor.
    pub(crate) unsafe fn first_of(files: &[&str]) -> Result<Self, LoadError> {
        let mut why = "this system has none".to_string();
        for file in files {
            // SAFETY: passed on to the caller.
            match unsafe { open(file) } {
                Ok(library) => return Ok(Self { library, file: (*file).to_string() }),
                Err(error) => why = one_line(&error),
            }
        }
        Err(LoadError::Missing { files: files.iter().map(|file| (*file).to_string()).collect(), why })
    }

    /// The function of this name.
    ///
    /// # Safety
    /// `F` must be the function's type, and it must not be called when `self` is gone.
    pub(crate) unsafe fn function<F: Copy>(&self, symbol: &'static str) -> Result<F, LoadError> {
        // SAFETY: the type is the caller's promise.
        match unsafe { self.library.get::<F>(symbol) } {
            Ok(function) => Ok(*function),
            Err(_) => Err(LoadError::Old { file: self.file.clone(), symbol }),
        }
    }
}

/// # Safety
/// As [`Loaded::first_of`].
#[cfg(windows)]
unsafe fn open(file: &str) -> Result<Library, libloading::Error> {
    use libloading::os::windows;
    // Not from the current folder: a firmware archive could bring a library of this name along.
    // SAFETY: passed on to the caller.
    unsafe { windows::Library::load_with_flags(file, windows::LOAD_LIBRARY_SEARCH_DEFAULT_DIRS) }
        .map(Library::from)
}

/// # Safety
/// As [`Loaded::first_of`].
#[cfg(not(windows))]
unsafe fn open(file: &str) -> Result<Library, libloading::Error> {
    // SAFETY: passed on to the caller. A bare name is looked for in the system's folders alone.
    unsafe { Library::new(file) }
}

/// What the system says, in one line: the error's own words are "dlopen failed", its source has more.
fn one_line(error: &libloading::Error) -> String {
    let source = std::error::Error::source(error).map(ToString::to_string);
    let text = source.unwrap_or_else(|| error.to_string());
    text.lines().next().unwrap_or_default().trim().to_string()
}
