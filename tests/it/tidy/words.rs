//! Rule for words that are never right in comments, pages, help and messages. These are archaic words, words that hide
//! the actor, British spelling, and words that the glossary has replaced. A doc comment must not start with a word such
//! as *what*, either.

use super::assert_rule;
use super::tree::SourceTree;

/// Endings of the paths of the files that are checked, each with the language of these files.
const LANGUAGES: [(&str, Language); 19] = [
    (".md", Language::Page),
    (".html", Language::Page),
    (".rs", Language::Rust),
    (".js", Language::Script),
    (".mjs", Language::Script),
    (".c", Language::C),
    (".h", Language::C),
    (".cpp", Language::C),
    (".hpp", Language::C),
    (".css", Language::C),
    (".py", Language::Python),
    (".pyi", Language::Python),
    (".lua", Language::Lua),
    (".toml", Language::Config),
    (".service", Language::Config),
    (".rules", Language::Config),
    (".cmake", Language::Config),
    (".sh", Language::Config),
    ("run", Language::Config),
];

#[derive(Clone, Copy, PartialEq)]
enum Language {
    /// A page, in which everything is prose except blocks of code and quoted code.
    Page,
    Rust,
    Script,
    C,
    Python,
    Lua,
    /// A file in which only comments are prose. Comments begin with `#`.
    Config,
}

/// Files that contain these words on purpose: the glossary, which lists replaced words, and this rule.
const EXEMPT_FILES: [&str; 2] = ["docs/glossary.md", "tests/it/tidy/words.rs"];

/// Phrases that are allowed, each with the reason.
const ALLOWED_PHRASES: [&str; 7] = [
    // A key of a world file.
    "centre = [",
    // An example of a flag that does not exist, in a test of the error for it.
    "--colour",
    // The former name of a flag. The error for this name has the new name.
    "--consumers",
    // The name of a page.
    "first-consumer",
    // The name of a value in JSON and in client libraries, and the row of this value in a generated table.
    "\"neighbour\"",
    "2 neighbour |",
    // The former name of a key. The error for this name has the new name.
    "consumers = 40",
];

/// Words and phrases that are never right. Each list of words has the advice what to write instead.
const NEVER: [(&[&str], &str); 6] = [
    (
        &[
            "anew",
            "whither",
            "whence",
            "thence",
            "lest",
            "thereof",
            "whereof",
            "whereby",
            "whereupon",
            "thereupon",
            "thereby",
            "hereby",
            "herein",
            "therein",
            "wherein",
            "thus",
            "hence",
            "henceforth",
            "hitherto",
            "heretofore",
            "albeit",
            "amidst",
            "amongst",
            "whilst",
            "shall",
            "ought to",
            "in vain",
            "for ever",
            "at the most",
            "none the worse",
            "for good or ill",
            "the begin",
            "manieth",
        ],
        "use the word of today: again, must, forever, at most, so, where",
    ),
    (
        &[
            "nobody",
            "nobody's",
            "somebody",
            "somebody's",
            "anybody",
            "anybody's",
            "everybody",
            "everybody's",
            "whoever",
            "whomever",
            "whosoever",
        ],
        "name the actor: a subscriber, another process, no client; for people, someone or no one",
    ),
    (
        &[
            "refuse to know",
            "refuses to know",
            "refuse to judge",
            "refuses to judge",
            "refuses to hide",
            "refuses to ask",
            "refuses to look",
            "refuses to say",
            "refuses to decide",
            "knows no",
            "knows neither",
            "knows nothing",
            "knows only",
            "know nothing of",
        ],
        "delete it, or name the module that does this",
    ),
    (
        &[
            "centre",
            "centred",
            "centres",
            "metre",
            "metres",
            "millimetre",
            "millimetres",
            "centimetre",
            "centimetres",
            "kilometre",
            "kilometres",
            "micrometre",
            "micrometres",
            "grey",
            "licence",
            "licences",
            "towards",
            "judgement",
            "cancelled",
            "cancelling",
            "labelled",
            "labelling",
            "modelled",
            "modelling",
            "travelled",
            "travelling",
            "artefact",
            "artefacts",
            "catalogue",
            "analyse",
            "analysed",
            "analyses",
            "defence",
            "programme",
        ],
        "use American spelling: center, meter, gray, toward, labeled",
    ),
    (
        &[
            "banner",
            "banners",
            "greeting",
            "greetings",
            "farewell",
            "consumer",
            "consumers",
            "processor time",
            "dialogue",
            "dialogues",
            "doubted",
            "persons",
            "whose head turns",
            "turning scanner",
            "turning scanners",
            "planted defect",
            "planted defects",
            "made-up time",
        ],
        "use the word of docs/glossary.md: boot message, subscriber, CPU time, rotating scanner",
    ),
    (
        &[
            "hub's life",
            "hub's lives",
            "gateway's life",
            "gateway's lives",
            "life of the hub",
            "lives of the hub",
            "life of a hub",
            "life of the gateway",
            "lives of the gateway",
            "all its lives",
            "each of its lives",
            "former life",
            "earlier life",
            "earlier lives",
            "in each life",
        ],
        "use the word of docs/glossary.md: a run",
    ),
];

/// Parts of British words, and beginnings of words that American English writes with a `z`. A word with such a
/// beginning is British if one of [`S_ENDINGS`] follows.
const BRITISH_STEMS: [&str; 6] = ["neighbour", "colour", "behaviour", "favour", "honour", "labour"];
const S_STEMS: [&str; 18] = [
    "recognis",
    "organis",
    "synchronis",
    "initialis",
    "normalis",
    "serialis",
    "optimis",
    "minimis",
    "maximis",
    "summaris",
    "realis",
    "generalis",
    "specialis",
    "localis",
    "parallelis",
    "visualis",
    "randomis",
    "penalis",
];
const S_ENDINGS: [&str; 7] = ["e", "es", "ed", "er", "ing", "ation", "ations"];

/// If a comment begins with one of these words, it has no subject.
const HEADLESS: [&str; 14] = [
    "what",
    "who",
    "whom",
    "whoever",
    "until when",
    "since when",
    "for how long",
    "by how much",
    "for whom",
    "for what",
    "of whom",
    "of which",
    "of what",
    "from whom",
];

/// A piece of prose: the words of a comment, paragraph or string, each with the number of the line in which it is.
struct Piece {
    is_comment: bool,
    words: Vec<(usize, String)>,
    /// Whether the first sentence is a question, which may begin with such a word.
    is_question: bool,
}

/// Returns an error for each place with words that are never right.
fn words_are_of_today(tree: &SourceTree) -> Vec<String> {
    let mut breaches = Vec::new();
    for (path, text) in tree.files("").filter(|(path, _)| !EXEMPT_FILES.contains(path)) {
        let Some((_, language)) = LANGUAGES.iter().find(|(ending, _)| path.ends_with(ending)) else {
            continue;
        };
        for piece in pieces(text, *language) {
            breaches.extend(wrong_words(&piece).map(|(line, wrong)| format!("{path}:{line}: {wrong}")));
        }
    }
    breaches
}

/// Returns each mistake in `piece`, as the number of its line and a description.
fn wrong_words(piece: &Piece) -> impl Iterator<Item = (usize, String)> {
    let words = &piece.words;
    let begins_at = |at: usize, phrase: &str| {
        let mut rest = words[at..].iter();
        phrase.split(' ').all(|word| rest.next().is_some_and(|(_, found)| found == word))
    };
    let mut wrong = Vec::new();
    for (at, (line, word)) in words.iter().enumerate() {
        for (phrases, advice) in NEVER {
            if let Some(phrase) = phrases.iter().find(|phrase| begins_at(at, phrase)) {
                wrong.push((*line, format!("{phrase:?}: {advice}")));
            }
        }
        let ends_with_s = |stem: &str| word.strip_prefix(stem).is_some_and(|end| S_ENDINGS.contains(&end));
        if BRITISH_STEMS.iter().any(|stem| word.contains(stem))
            || S_STEMS.iter().any(|stem| ends_with_s(stem))
        {
            wrong.push((*line, format!("{word:?}: use American spelling")));
        }
    }
    if piece.is_comment
        && !piece.is_question
        && let Some((line, _)) = words.first()
        && let Some(phrase) = HEADLESS.iter().find(|phrase| begins_at(0, phrase))
    {
        wrong.push((*line, format!("a comment that begins with {phrase:?}: begin with a noun or a verb")));
    }
    wrong.into_iter()
}

/// Splits `text` into pieces of prose. Leaves out code, quoted code, and strings that contain no space.
fn pieces(text: &str, language: Language) -> Vec<Piece> {
    let mut found: Vec<(usize, Kind, String)> = Vec::new();
    match language {
        Language::Page => prose_of_page(text, &mut found),
        _ => prose_of_source(text, language, &mut found),
    }
    let mut pieces: Vec<Piece> = Vec::new();
    let mut last: Option<(usize, Kind)> = None;
    let mut sentence = String::new();
    for (line, kind, text) in found {
        let text = ALLOWED_PHRASES.iter().fold(text, |text, phrase| text.replace(phrase, " "));
        let text = without_code(&text, kind);
        let continues =
            last.is_some_and(|(before, of)| of == kind && before + 1 >= line && kind != Kind::Text);
        if !continues || text.trim().is_empty() {
            sentence.clear();
            let is_comment = kind == Kind::Comment || kind == Kind::Doc;
            pieces.push(Piece { is_comment, words: Vec::new(), is_question: false });
        }
        last = Some((line, kind));
        let piece = pieces.last_mut().expect("a piece");
        sentence += &text;
        piece.is_question =
            sentence.split_inclusive(['.', '?']).next().is_some_and(|first| first.ends_with('?'));
        let is_part = |c: char| c.is_alphanumeric() || "_-'".contains(c);
        let words = text.split(|c| !is_part(c)).filter(|word| !word.is_empty());
        piece.words.extend(words.map(|word| (line, word.trim_matches('\'').to_lowercase())));
    }
    pieces
}

/// Returns `text` without quoted code. If it is a message, the names in braces are removed, too.
fn without_code(text: &str, kind: Kind) -> String {
    let text: Vec<&str> = text.split('`').step_by(2).collect();
    let text = text.join(" x ");
    if kind != Kind::Text {
        return text;
    }
    let parts = text.split('{').enumerate();
    parts
        .map(|(at, part)| if at == 0 { part } else { part.split_once('}').map_or(part, |(_, rest)| rest) })
        .collect()
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Doc,
    Comment,
    Text,
    Page,
}

/// Appends the lines of a page without its code blocks.
fn prose_of_page(text: &str, found: &mut Vec<(usize, Kind, String)>) {
    let mut is_code = false;
    for (number, line) in text.lines().enumerate() {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        if !is_code && !is_fence {
            found.push((number + 1, Kind::Page, line.to_owned()));
        }
    }
}

/// Appends the comments and strings of a source.
fn prose_of_source(text: &str, language: Language, found: &mut Vec<(usize, Kind, String)>) {
    let marks: &[&str] = match language {
        Language::Rust | Language::Script | Language::C => &["//"],
        Language::Lua => &["--"],
        _ => &["#"],
    };
    let has_blocks = matches!(language, Language::Rust | Language::Script | Language::C);
    let has_strings = language != Language::Config;
    let (mut at, mut line) = (0, 1);
    while let Some(c) = text[at..].chars().next() {
        let rest = &text[at..];
        let is_after_space = at == 0 || text[..at].ends_with(char::is_whitespace);
        if c == '\n' {
            line += 1;
            at += 1;
        } else if marks.iter().any(|mark| rest.starts_with(mark)) && (has_strings || is_after_space) {
            let comment = rest.lines().next().unwrap_or_default();
            let kind = if comment.starts_with("///") || comment.starts_with("//!") {
                Kind::Doc
            } else {
                Kind::Comment
            };
            found.push((line, kind, comment.trim_start_matches(['/', '!', '#', '-']).to_owned()));
            at += comment.len();
        } else if has_blocks && rest.starts_with("/*") {
            let end = rest.find("*/").map_or(rest.len(), |end| end + 2);
            let lines = rest[..end].lines().map(|line| line.trim().trim_matches(['*', '/']));
            let lines: Vec<_> =
                lines.enumerate().map(|(below, text)| (line + below, Kind::Doc, text.to_owned())).collect();
            found.push((line, Kind::Doc, String::new()));
            found.extend(lines);
            line += rest[..end].matches('\n').count();
            at += end;
        } else if has_strings
            && let Some((content, length)) = string(rest, text[..at].chars().next_back(), language)
        {
            let is_doc = language == Language::Python && rest.starts_with("\"\"\"");
            let kind = if is_doc { Kind::Doc } else { Kind::Text };
            if is_doc {
                found.push((line, kind, String::new()));
            }
            if content.contains(' ') {
                for (below, text) in content.split('\n').enumerate() {
                    found.push((line + below, kind, text.replace("\\n", " ")));
                }
            }
            line += rest[..length].matches('\n').count();
            at += length;
        } else {
            at += c.len_utf8();
        }
    }
}

/// Returns the content of the string at the start of `text`, and its length with quotes. `before` is the character in
/// front of it.
fn string(text: &str, before: Option<char>, language: Language) -> Option<(&str, usize)> {
    let is_name = before.is_some_and(|c| c.is_alphanumeric() || c == '_');
    if language == Language::Rust {
        if let Some(rest) = text.strip_prefix('\'') {
            // The quote starts a character or a lifetime.
            let after = rest.chars().next()?;
            let close = match after {
                '\\' => {
                    2 + text[2..]
                        .find('\'')
                        .filter(|&at| at > 0)
                        .or_else(|| text[3..].find('\'').map(|at| at + 1))?
                }
                _ => 1 + after.len_utf8(),
            };
            return text[close..].starts_with('\'').then_some(("", close + 1));
        }
        if text.starts_with('r') && (!is_name || before == Some('b')) {
            let hashes = text[1..].len() - text[1..].trim_start_matches('#').len();
            let begin = 1 + hashes;
            if text[begin..].starts_with('"') {
                let end = format!("\"{}", "#".repeat(hashes));
                let close = begin + 1 + text[begin + 1..].find(&end)?;
                return Some((&text[begin + 1..close], close + end.len()));
            }
        }
    }
    if language == Language::Python
        && let Some(quote) = ["\"\"\"", "'''"].into_iter().find(|quote| text.starts_with(quote))
    {
        let close = 3 + text[3..].find(quote)?;
        return Some((&text[3..close], close + 3));
    }
    let quotes: &[char] = match language {
        Language::Rust | Language::C => &['"'],
        Language::Script => &['"', '\'', '`'],
        _ => &['"', '\''],
    };
    let quote = text.chars().next().filter(|c| quotes.contains(c))?;
    let is_short = language != Language::Rust && quote != '`';
    let mut is_escaped = false;
    for (at, c) in text.char_indices().skip(1) {
        match c {
            _ if is_escaped => is_escaped = false,
            '\\' => is_escaped = true,
            '\n' if is_short => return None,
            _ if c == quote => return Some((&text[1..at], at + 1)),
            _ => {}
        }
    }
    None
}

#[test]
fn forbidden_words_are_not_used() {
    assert_rule(words_are_of_today, |_| {
        let mut planted = Vec::new();
        for (words, _) in NEVER {
            for words in words {
                planted.push(SourceTree::of_file(
                    "docs/planted.md",
                    &format!("# A page\n\nIt says\n{words} in a text.\n"),
                ));
            }
        }
        for (path, text) in PLANTED {
            planted.push(SourceTree::of_file(path, text));
        }
        for words in HEADLESS {
            planted.push(SourceTree::of_file(
                "hub/daemon/src/planted.rs",
                &format!("//! A file.\n\n/// {words} waits.\n"),
            ));
        }
        planted
    });
}

/// Files with a mistake in a comment or a message, for each kind of file. The rule must find each mistake.
const PLANTED: [(&str, &str); 26] = [
    ("schema/src/planted.rs", "//! A file.\n// Begins anew.\n"),
    ("schema/src/planted.rs", "//! A file that refuses\n//! to know sockets.\n"),
    ("schema/src/planted.rs", "//! A file.\nlet text = 'a'; // nobody\n"),
    ("schema/src/planted.rs", "//! A file.\nlet text = '\"'; // nobody\n"),
    ("schema/src/planted.rs", "//! A file.\nlet text = \"\\\"\"; // nobody\n"),
    ("schema/src/planted.rs", "//! A file.\nlet text = r#\"a \" b\"#; // nobody\n"),
    ("schema/src/planted.rs", "//! A file.\npanic!(\"there is nobody\");\n"),
    ("schema/src/planted.rs", "//! A file.\npanic!(\n    \"there is \\\n     nobody\"\n);\n"),
    ("schema/src/planted.rs", "//! A file.\n\n/** What is left. */\n"),
    ("schema/src/planted.rs", "//! A file.\n\n/// Neighbouring colours.\n"),
    ("schema/src/planted.rs", "//! A file.\n\n/// Synchronises clocks.\n"),
    ("schema/src/planted.rs", "//! What waits.\n"),
    ("clients/viewer/page/planted.js", "const text = 'a grey line';\n"),
    ("clients/viewer/page/planted.js", "draw(); // in grey\n"),
    ("clients/viewer/page/planted.css", "/* A grey line */\n"),
    ("clients/viewer/page/planted.html", "<p>A grey line</p>\n"),
    ("clients/c/planted.h", "/*\n * Who a sensor is.\n */\n"),
    ("clients/c/planted.c", "int main(void) { return 0; } /* A farewell. */\n"),
    ("clients/c/planted.cpp", "// Towards the end.\n"),
    ("clients/python/planted.py", "\"\"\"What cannot be followed.\"\"\"\n"),
    ("clients/python/planted.py", "def f():\n    # The hub's life.\n    pass\n"),
    ("clients/wireshark/planted.lua", "-- Why nobody knows.\n"),
    ("tests/worlds/planted.toml", "radius_m = 1 # half a metre\n"),
    ("hub/dist/planted.service", "# What a restart does not change.\n"),
    ("hub/dist/planted.rules", "# It shall run.\n"),
    (".ci/run", "# Tests that nobody runs.\n"),
];

#[test]
fn code_and_names_are_not_checked_for_words() {
    let texts = [
        ("//! A file.\nstruct Nobody { centre: Point }\n", Language::Rust),
        ("//! A file.\nsubscribe(\"nobody/scan\");\n", Language::Rust),
        ("//! A file.\n// See `centre`.\nlet life: &'static str = \"\";\n", Language::Rust),
        ("//! A file.\n// What if there is none? Then it waits.\n", Language::Rust),
        ("//! A file.\nformat!(\"{persons} near {nobody:?}\");\n", Language::Rust),
        ("centre = [1, 2]\n# centre = [1, 2]\n", Language::Config),
        ("# A page\n\n```toml\n# nobody\n```\n\nSee `neighbour`. What is a scan?\n", Language::Page),
    ];
    for (text, language) in texts {
        let wrong: Vec<_> = pieces(text, language).iter().flat_map(wrong_words).collect();
        assert_eq!(wrong, [], "{text}");
    }
}
