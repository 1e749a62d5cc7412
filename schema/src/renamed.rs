//! Configuration keys and flags whose names have changed. The old names are errors that state the new ones.

/// Old and new name of each key and flag.
const RENAMED: [(&str, &str); 5] = [
    ("zones.self_min", "zones.body_mask"),
    ("marks.i_min", "marks.min_level"),
    ("lines.polish", "lines.refine"),
    ("limits.consumers", "limits.subscribers"),
    ("--consumers", "--subscribers"),
];

/// Returns the new name of the flag `old`, or of the configuration key whose last part is `old`.
pub fn renamed(old: &str) -> Option<&'static str> {
    let last = |name: &'static str| name.rsplit('.').next();
    RENAMED.iter().find(|(known, _)| last(known) == Some(old)).map(|(_, new)| *new)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_new_names_of_old_ones_only() {
        assert_eq!(renamed("self_min"), Some("zones.body_mask"));
        assert_eq!(renamed("--consumers"), Some("--subscribers"));
        assert_eq!((renamed("body_mask"), renamed("--memory"), renamed("")), (None, None, None));
        assert!(RENAMED.iter().all(|(old, _)| RENAMED.iter().all(|(_, new)| old != new)));
    }
}
