//! An error of the work, and its Python exception (`coflash/errors.py`).

use coflash_core::device::Error;
use coflash_core::file::ram_image;
use coflash_core::file::sealed::Refusal;
use coflash_core::file::FileError;
use coflash_core::update::refusal_number;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// An error.
#[derive(Debug)]
pub enum Fault {
    /// An argument is invalid.
    Value(String),
    /// The file is invalid.
    File(FileError),
    /// The sealed image with this name is invalid.
    Sealed(String, Refusal),
    /// The bootloader in the file with this name is invalid.
    Bootloader(String, ram_image::Fault),
    /// An error of the bus or the device.
    Device(Error),
}

impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Self::Device(error)
    }
}

impl Fault {
    /// The exception for it.
    pub fn raise(self, py: Python<'_>) -> PyErr {
        let (class, number, what, advice) = match self {
            Self::Value(what) => return PyValueError::new_err(what),
            Self::File(error) => ("FileError", error.error.cause.number(), error.to_string(), String::new()),
            Self::Sealed(file, refusal) => {
                let what = format!("{file}: {refusal}");
                ("FileError", refusal_number(&refusal), what, refusal.advice().to_string())
            }
            Self::Bootloader(file, fault) => {
                let advice = ram_image::Fault::ADVICE.to_owned();
                ("FileError", ram_image::Fault::NUMBER, format!("{file}: {fault}"), advice)
            }
            Self::Device(error) => {
                let class = match &error {
                    Error::Adapter(_) => "BusError",
                    Error::Cancelled => "Cancelled",
                    _ => "DeviceError",
                };
                (class, error.number(), error.to_string(), error.advice().to_string())
            }
        };
        let exception = py
            .import("coflash.errors")
            .and_then(|errors| errors.getattr(class))
            .and_then(|class| class.call1((number, what, advice)));
        exception.map_or_else(|error| error, PyErr::from_value)
    }
}
