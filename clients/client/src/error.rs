//! Errors of the client library. Each has a class for the program, and a message with a remedy for its user.

use std::error;
use std::fmt;
use std::sync::Arc;

use scanhub_schema::{Failure, Kind, Printable};

/// Error of any call of this library.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, ErrorKind, Scan, subscribe};
///
/// let mut scans = subscribe::<Scan>("front")?;
/// match scans.next() {
///     Ok(_) => {}
///     Err(Error::TooManyHeld) => println!("drop a scan"),
///     Err(error) if error.kind() == ErrorKind::ResourceExhausted => println!("later: {}", error.remedy()),
///     Err(error) => return Err(error),
/// }
/// # Ok::<(), Error>(())
/// ```
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Error {
    /// The program holds four samples of this subscriber. The next sample is received after one of them is dropped.
    TooManyHeld,
    /// Any other error; [`Error::kind`] returns its class.
    Failed(Box<Cause>),
}

/// Class of an [`Error`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// A name, a limit or a combination of options is invalid.
    InvalidInput,
    /// No hub runs in the domain.
    NoHub,
    /// The hub has no such sensor.
    NoTopic,
    /// The hub did not respond in time.
    Timeout,
    /// The program ended the call.
    Interrupted,
    /// Another process has the lock of the domain.
    DomainHeld,
    /// Another process publishes under the name.
    NameHeld,
    /// Memory, descriptors or slots for subscribers have run out; a later attempt may succeed.
    ResourceExhausted,
    /// The program holds four samples of one subscriber.
    TooManyHeld,
    /// The domain, or a file in it, belongs to another user.
    OtherUser,
    /// The hub uses another layout of payloads, or another version of the shared memory.
    Incompatible,
    /// Any other failure, for example of a request that the link cannot execute.
    Failed,
}

/// Message, remedy and source of an [`Error`].
#[derive(Clone, Debug)]
pub struct Cause {
    failure: Failure,
    kind: ErrorKind,
    source: Option<Arc<dyn error::Error + Send + Sync>>,
}

impl Error {
    pub(crate) fn new(kind: Kind, message: impl Into<String>, remedy: impl Into<String>) -> Error {
        Failure::new(kind, message, remedy).into()
    }

    /// Returns this error with the error of the system that has caused it.
    pub(crate) fn with_source(mut self, error: impl error::Error + Send + Sync + 'static) -> Error {
        if let Error::Failed(cause) = &mut self {
            cause.source = Some(Arc::new(error));
        }
        self
    }

    /// Returns this error with another class. The class does not change the exit code of a program that ends with the
    /// error.
    pub(crate) fn with_kind(mut self, kind: ErrorKind) -> Error {
        if let Error::Failed(cause) = &mut self {
            cause.kind = kind;
        }
        self
    }

    /// Returns the class of the error.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Error::TooManyHeld => ErrorKind::TooManyHeld,
            Error::Failed(cause) => cause.kind,
        }
    }

    /// Returns the message without the remedy, with control characters replaced.
    pub fn message(&self) -> String {
        match self {
            Error::TooManyHeld => TOO_MANY_HELD.0.to_owned(),
            Error::Failed(cause) => Printable(&cause.failure.message).to_string(),
        }
    }

    /// Returns the remedy for the user, with control characters replaced. Empty if no remedy is known.
    pub fn remedy(&self) -> String {
        match self {
            Error::TooManyHeld => TOO_MANY_HELD.1.to_owned(),
            Error::Failed(cause) => Printable(&cause.failure.hint).to_string(),
        }
    }
}

impl fmt::Display for Error {
    /// Writes the message, and the remedy in a second line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message())?;
        match self.remedy() {
            remedy if remedy.is_empty() => Ok(()),
            remedy => write!(f, "\n  {remedy}"),
        }
    }
}

impl error::Error for Error {
    fn source(&self) -> Option<&(dyn error::Error + 'static)> {
        let Error::Failed(cause) = self else { return None };
        cause.source.as_deref().map(|source| source as &(dyn error::Error + 'static))
    }
}

impl From<Failure> for Error {
    fn from(failure: Failure) -> Error {
        let kind = match failure.kind {
            Kind::Usage | Kind::Configuration => ErrorKind::InvalidInput,
            Kind::NoHub => ErrorKind::NoHub,
            Kind::NoTopic => ErrorKind::NoTopic,
            Kind::Timeout => ErrorKind::Timeout,
            Kind::Interrupted => ErrorKind::Interrupted,
            Kind::DomainHeld => ErrorKind::DomainHeld,
            Kind::NameHeld => ErrorKind::NameHeld,
            Kind::ResourceExhausted => ErrorKind::ResourceExhausted,
            Kind::OtherUser => ErrorKind::OtherUser,
            Kind::Incompatible => ErrorKind::Incompatible,
            _ => ErrorKind::Failed,
        };
        Error::Failed(Box::new(Cause { failure, kind, source: None }))
    }
}

/// Conversion for programs that end with the exit codes of `scanhub`.
impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        match error {
            Error::TooManyHeld => Failure::new(Kind::Failed, TOO_MANY_HELD.0, TOO_MANY_HELD.1),
            Error::Failed(cause) => cause.failure,
        }
    }
}

/// Message and remedy of [`Error::TooManyHeld`].
const TOO_MANY_HELD: (&str, &str) = ("more than four samples are held", "drop them before the next one");

#[cfg(test)]
mod tests {
    use std::error::Error as _;
    use std::io;

    use super::*;

    #[test]
    fn error_and_failure_convert_without_loss() {
        for kind in [Kind::Failed, Kind::Configuration, Kind::NoHub, Kind::NameHeld, Kind::ResourceExhausted]
        {
            let failure = Failure::new(kind, "no \x1b port", "try \x07 another");
            let error = Error::from(failure.clone());
            assert_eq!(error.to_string(), failure.to_string());
            assert_eq!((&error.message()[..], &error.remedy()[..]), ("no ? port", "try ? another"));
            assert_eq!(Failure::from(error), failure);
        }
        assert_eq!(Error::new(Kind::Failed, "alone", "").to_string(), "alone");
    }

    #[test]
    fn failure_kinds_map_to_public_error_kinds() {
        let kind = |kind| Error::new(kind, "", "").kind();
        assert_eq!(kind(Kind::Configuration), ErrorKind::InvalidInput);
        assert_eq!(kind(Kind::Usage), ErrorKind::InvalidInput);
        assert_eq!(kind(Kind::ResourceExhausted), ErrorKind::ResourceExhausted);
        assert_eq!(kind(Kind::PortBusy), ErrorKind::Failed);
        assert_eq!(kind(Kind::Incompatible), ErrorKind::Incompatible);
        assert_eq!(kind(Kind::OtherUser), ErrorKind::OtherUser);
        let no_hub = Error::new(Kind::NoHub, "", "").with_kind(ErrorKind::OtherUser);
        assert_eq!((no_hub.kind(), Failure::from(no_hub).kind), (ErrorKind::OtherUser, Kind::NoHub));
        assert_eq!(Error::TooManyHeld.kind(), ErrorKind::TooManyHeld);
        assert!(!Error::TooManyHeld.remedy().is_empty());
    }

    #[test]
    fn error_source_is_the_os_error() {
        let error = Error::new(Kind::ResourceExhausted, "no descriptor", "");
        assert!(error.source().is_none());
        let error = error.with_source(io::Error::from_raw_os_error(24));
        let source = error.source().and_then(|source| source.downcast_ref::<io::Error>());
        assert_eq!(source.and_then(io::Error::raw_os_error), Some(24));
        let boxed: Box<dyn std::error::Error + Send + Sync> = error.into();
        assert!(boxed.source().is_some());
    }
}
