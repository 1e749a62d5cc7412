//! Parser for the shell syntax that examples use: comments, quotes, pipes and redirections.
#![allow(dead_code)] // Each test uses only some items of this module.

/// Returns the lines of a block without comments and empty lines.
pub(crate) fn lines(text: &str) -> Vec<String> {
    let lines = text.lines().map(|line| without_comment(line).trim().to_owned());
    lines.filter(|line| !line.is_empty()).collect()
}

/// Returns the words of each command in `line`, without redirections.
pub(crate) fn commands(line: &str) -> Vec<Vec<String>> {
    let mut commands = vec![Vec::new()];
    let mut is_redirected = false;
    for (word, is_quoted) in words(line) {
        match word.as_str() {
            "|" | "&&" | ";" if !is_quoted => commands.push(Vec::new()),
            ">" | "<" if !is_quoted => is_redirected = true,
            _ if is_redirected => is_redirected = false,
            _ => commands.last_mut().expect("at least one command").push(word),
        }
    }
    commands
}

/// Returns the words of each `scanhub` command in `line`, including the commands that `cargo run` starts. Commands that
/// start an example with `cargo run --example` do not count.
pub(crate) fn scanhub_commands(line: &str) -> Vec<Vec<String>> {
    let of_cargo = |words: &[String]| {
        let at = words
            .iter()
            .position(|word| word == "--")
            .filter(|_| words.starts_with(&["cargo".into(), "run".into()]))
            .filter(|_| !words.contains(&"--example".into()))?;
        Some([&["scanhub".to_owned()], &words[at + 1..]].concat())
    };
    let commands = commands(line).into_iter();
    let ours = commands.filter_map(|words| match words.first()?.as_str() {
        "scanhub" => Some(words),
        _ => of_cargo(&words),
    });
    ours.collect()
}

/// Returns the words of `line` that a shell may treat as a pattern for file names. They must be quoted, because zsh
/// refuses a pattern that matches no file.
pub(crate) fn patterns(line: &str) -> Vec<String> {
    let (mut quote, mut plain) = (None, String::new());
    for sign in without_comment(line).chars() {
        match (quote, sign) {
            (None, '\'' | '"') => quote = Some(sign),
            (Some(open), _) if open == sign => quote = None,
            (None, _) => plain.push(sign),
            _ => {}
        }
    }
    plain.split(' ').filter(|word| word.contains(['[', '*', '?'])).map(str::to_owned).collect()
}

fn without_comment(line: &str) -> &str {
    let mut quote = None;
    let mut before = ' ';
    for (at, sign) in line.char_indices() {
        match (quote, sign) {
            (None, '#') if before == ' ' => return &line[..at],
            (None, '\'' | '"') => quote = Some(sign),
            (Some(open), _) if open == sign => quote = None,
            _ => {}
        }
        before = sign;
    }
    line
}

/// Returns the words and operators of `line`. The flag of each is true if it was quoted.
fn words(line: &str) -> Vec<(String, bool)> {
    let mut words = Vec::new();
    let (mut word, mut quote, mut is_quoted) = (String::new(), None, false);
    for sign in without_comment(line).chars().chain([' ']) {
        match (quote, sign) {
            (None, '\'' | '"') => (quote, is_quoted) = (Some(sign), true),
            (Some(open), _) if open == sign => quote = None,
            (None, ' ' | '|' | ';' | '>' | '<') => {
                if !word.is_empty() || is_quoted {
                    words.push((std::mem::take(&mut word), is_quoted));
                }
                is_quoted = false;
                if sign != ' ' {
                    words.push((sign.into(), false));
                }
            }
            _ => word.push(sign),
        }
    }
    words
}

#[test]
fn page_lines_are_parsed_like_a_shell() {
    assert_eq!(lines("# no\na b   # c\n\nd '# e'#f\n"), ["a b", "d '# e'#f"]);
    let line = "scanhub a 'b c' \"d|e\" | scanhub f > g && x; cargo run --release -- h i # j";
    let expected: [&[&str]; 4] = [
        &["scanhub", "a", "b c", "d|e"],
        &["scanhub", "f"],
        &["x"],
        &["cargo", "run", "--release", "--", "h", "i"],
    ];
    assert_eq!(commands(line), expected);
    assert_eq!(scanhub_commands(line), [expected[0], expected[1], &["scanhub", "h", "i"]]);
    assert_eq!(commands(""), [[""; 0]]);
    let line = "scanhub a 'x[1]' \"*\" b=[2] c? d '*'e* # f*";
    assert_eq!(patterns(line), ["b=[2]", "c?", "e*"]);
}
