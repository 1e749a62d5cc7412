//! Search for rare values in arrays with one value for each beam.

/// Returns the index of the first value from `from` on for which `is_it` is true, or `None` if there is no such value.
/// Such values must be rare: the search tests whole blocks of values, without a branch for each value.
pub(crate) fn position<T: Copy>(values: &[T], from: usize, is_it: impl Fn(T) -> bool) -> Option<usize> {
    const BLOCK: usize = 32;
    let mut begin = from;
    while let Some(block) = values[begin..].first_chunk::<BLOCK>() {
        if block.iter().fold(false, |any, &value| any | is_it(value)) {
            break;
        }
        begin += BLOCK;
    }
    values[begin..].iter().position(|&value| is_it(value)).map(|ahead| begin + ahead)
}
