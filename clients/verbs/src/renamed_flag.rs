//! Adds the new name of a flag to the error for its old name.

use clap::error::{ContextKind, ContextValue};
use scanhub_schema::renamed;

/// Returns `error`. If `error` is about a flag that was renamed, adds a tip with the new name.
pub fn with_new_name(mut error: clap::Error) -> clap::Error {
    let new = match error.get(ContextKind::InvalidArg) {
        Some(ContextValue::String(flag)) => renamed(flag),
        _ => None,
    };
    if let Some(new) = new {
        error.insert(ContextKind::SuggestedArg, ContextValue::String(new.to_owned()));
    }
    error
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_for_an_old_flag_states_the_new_one() {
        let error = |flag: &str| {
            let error = clap::Command::new("listen").try_get_matches_from(["listen", flag]).unwrap_err();
            with_new_name(error).to_string()
        };
        let old = error("--consumers=3");
        assert!(old.contains("'--consumers'") && old.contains("'--subscribers'"), "{old}");
        assert!(!error("--other=3").contains("--subscribers"));
    }
}
