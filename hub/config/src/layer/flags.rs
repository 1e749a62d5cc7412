//! What a flag says, as TOML: `--set KEY=VALUE` and `--link NAME=PORT`. Refuses to know which keys there are.

/// `link.NAME.KEY=VALUE`, or a key of all links as `zones.margin=0.05`, as TOML; a value that is none is taken as text.
pub(crate) fn setting(flag: &str) -> Option<String> {
    let (path, value) = flag.split_once('=')?;
    let (table, key) = path.split_once('.')?;
    let (head, key) = match (table, key.split_once('.')) {
        ("link", Some((name, key))) => (format!("[[link]]\nname = {}\n", quoted(name)), key),
        ("link", None) => return None,
        _ => (String::new(), path),
    };
    let is_key = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if key == "name" || key.split('.').any(|word| word.is_empty() || !word.chars().all(is_key)) {
        return None;
    }
    Some(format!("{head}{key} = {}", written(value)))
}

/// `NAME=PORT`, which may end with `,KEY=VALUE` as often as it likes, as TOML.
pub(crate) fn link(flag: &str) -> Option<String> {
    let (name, rest) = flag.split_once('=')?;
    let is_set = |part: &&str| {
        part.split_once('=')
            .is_some_and(|(key, _)| key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c == '.'))
    };
    // A comma may be in the name of a port.
    let parts: Vec<&str> = rest.split(',').collect();
    let set = parts.iter().rev().take_while(|part| is_set(part)).count().min(parts.len() - 1);
    let (port, set) = parts.split_at(parts.len() - set);
    let mut text = format!("[[link]]\nname = {}\nport = {}", quoted(name), quoted(&port.join(",")));
    for (key, value) in set.iter().filter_map(|part| part.split_once('=')) {
        text = format!("{text}\n{key} = {}", written(value));
    }
    Some(text)
}

/// `value` as TOML: as text, if it is nothing else.
fn written(value: &str) -> String {
    match toml::from_str::<toml::Table>(&format!("v = {value}")) {
        Ok(table) if table.len() == 1 => value.to_owned(),
        _ => quoted(value),
    }
}

/// As a TOML string.
fn quoted(text: &str) -> String {
    let escaped: String = text
        .chars()
        .map(|c| match c {
            '"' | '\\' => format!("\\{c}"),
            c if c.is_control() => format!("\\u{:04X}", c as u32),
            c => c.to_string(),
        })
        .collect();
    format!("\"{escaped}\"")
}
