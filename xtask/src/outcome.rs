//! The result of a job.

/// Nothing, or a message with the error and its remedy.
pub type Outcome<T = ()> = Result<T, String>;
