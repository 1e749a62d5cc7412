//! Text in a fixed field of bytes: UTF-8, padded with 0, cut at a character boundary if it is too long.

/// Writes `text` into `field` and clears the rest.
pub(crate) fn write(field: &mut [u8], text: &str) {
    let mut end = text.len().min(field.len());
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    field[..end].copy_from_slice(&text.as_bytes()[..end]);
    field[end..].fill(0);
}

/// The text in `field`, up to the first 0; what is not UTF-8 ends it.
pub(crate) fn read(field: &[u8]) -> &str {
    let end = field.iter().position(|&byte| byte == 0).unwrap_or(field.len());
    match str::from_utf8(&field[..end]) {
        Ok(text) => text,
        Err(error) => str::from_utf8(&field[..error.valid_up_to()]).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_cut_at_a_character_and_the_rest_cleared() {
        let mut field = [0xAA; 5];
        write(&mut field, "abcdé");
        assert_eq!(field, *b"abcd\0");
        assert_eq!(read(&field), "abcd");
        write(&mut field, "é");
        assert_eq!(read(&field), "é");
        assert_eq!(field[2..], [0; 3]);
    }

    #[test]
    fn bytes_that_are_not_text_end_it() {
        assert_eq!(read(b"ab\xFFcd"), "ab");
    }
}
