//! Loads a library and finds its functions.

use libloading::Library;

/// Why a library cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LoadError {
    /// None of its files exists or can be loaded.
    #[error("the library {} cannot be loaded ({why})", files.join(" or "))]
    Missing {
        /// The file names that were tried, in this order.
        files: Vec<String>,
        /// The system's message about the last one.
        why: String,
    },
    /// The library lacks a required function: it is an old version, or another library.
    #[error("the library {file} has no function {symbol}")]
    Old {
        /// The file.
        file: String,
        /// The function.
        symbol: &'static str,
    },
}

/// A loaded library, and its file name.
pub(crate) struct Loaded {
    library: Library,
    file: String,
}

impl Loaded {
    /// Loads the first of these files that can be loaded.
    ///
    /// # Safety
    /// The library's start-up code runs: the files must be the vendor's.
    pub(crate) unsafe fn first_of(files: &[&str]) -> Result<Self, LoadError> {
        let mut why = "this system has none".to_string();
        for file in files {
            // SAFETY: the caller guarantees this.
            match unsafe { open(file) } {
                Ok(library) => return Ok(Self { library, file: (*file).to_string() }),
                Err(error) => why = one_line(&error),
            }
        }
        Err(LoadError::Missing { files: files.iter().map(|file| (*file).to_string()).collect(), why })
    }

    /// The function with this name.
    ///
    /// # Safety
    /// `F` must be the function's type, and the function must not be called after `self` was
    /// dropped.
    pub(crate) unsafe fn function<F: Copy>(&self, symbol: &'static str) -> Result<F, LoadError> {
        // SAFETY: the caller guarantees the type.
        match unsafe { self.library.get::<F>(symbol) } {
            Ok(function) => Ok(*function),
            Err(_) => Err(LoadError::Old { file: self.file.clone(), symbol }),
        }
    }
}

/// A vendor's library: its functions, with their names and types of its header. The safe
/// ones take and return plain numbers, and become methods.
macro_rules! library {
    (
        $name:ident from $files:expr,
        unsafe { $($function:ident: $symbol:literal = fn($($argument:ty),*) $(-> $result:ty)?;)* }
        safe { $($plain:ident: $of:literal = fn($($number:ident: $type:ty),*) -> $status:ty;)* }
    ) => {
        /// The library.
        pub struct $name {
            $($function: unsafe extern "system" fn($($argument),*) $(-> $result)?,)*
            $($plain: unsafe extern "system" fn($($type),*) -> $status,)*
            // The last field, because the functions above belong to it.
            _library: $crate::load::Loaded,
        }

        impl std::fmt::Debug for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(concat!(stringify!($name), "(…)"))
            }
        }

        impl $name {
            /// Finds the library and its functions.
            fn find() -> Result<Self, $crate::load::LoadError> {
                // SAFETY: the files come from the vendor's installer; the types are those of its
                // header, and the functions live as long as the library beside them.
                unsafe {
                    let library = $crate::load::Loaded::first_of($files)?;
                    Ok(Self {
                        $($function: library.function($symbol)?,)*
                        $($plain: library.function($of)?,)*
                        _library: library,
                    })
                }
            }

            $(
                #[doc = concat!("`", $of, "`: returns what the library returns.")]
                pub fn $plain(&self, $($number: $type),*) -> $status {
                    // SAFETY: the arguments are plain numbers.
                    unsafe { (self.$plain)($($number),*) }
                }
            )*
        }
    };
}
pub(crate) use library;

/// # Safety
/// As [`Loaded::first_of`].
#[cfg(windows)]
unsafe fn open(file: &str) -> Result<Library, libloading::Error> {
    use libloading::os::windows;
    // Not from the current folder: a firmware archive could contain a library with this name.
    // SAFETY: the caller guarantees this.
    unsafe { windows::Library::load_with_flags(file, windows::LOAD_LIBRARY_SEARCH_DEFAULT_DIRS) }
        .map(Library::from)
}

/// # Safety
/// As [`Loaded::first_of`].
#[cfg(not(windows))]
unsafe fn open(file: &str) -> Result<Library, libloading::Error> {
    // SAFETY: the caller guarantees this. A bare name is only looked up in the system's folders.
    unsafe { Library::new(file) }
}

/// The system's message in one line: the error itself only says "dlopen failed", and its source has
/// the details.
fn one_line(error: &libloading::Error) -> String {
    let source = std::error::Error::source(error).map(ToString::to_string);
    let text = source.unwrap_or_else(|| error.to_string());
    text.lines().next().unwrap_or_default().trim().to_string()
}
