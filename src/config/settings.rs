//! Settings of a command from a file, the environment and flags: flags win over the environment, the environment
//! over the file, and the file over defaults.
//!
//! 1. Flags are the one list of settings: a key of the file is the name of a flag, `_` in place of `-`, in a table
//!    with the command's name. Values are read by the parsers of the flags.
//! 2. Each value is tried by itself first, so that all faults are told at once, each with its place.
//! 3. Secrets are in no fault, and not in what `--print-config` shows.

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    fs,
    path::Path,
};

use clap::{Arg, ArgAction, Command};
use toml::de::{DeTable, DeValue};

/// Commands that have settings.
const COMMANDS: [&str; 2] = ["serve", "worker"];

/// Where a value is from, and its text.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Setting {
    place: String,
    text: OsString,
}

/// A command line that says all that is set anywhere.
#[derive(Debug, Default)]
pub(crate) struct Settings {
    /// For clap, which reads the environment by itself.
    pub(crate) argv: Vec<OsString>,
    /// What is wrong with single values.
    pub(crate) faults: Vec<String>,
    /// By name of the flag.
    set: BTreeMap<String, Setting>,
    table: String,
}

impl Settings {
    /// Gathers what concerns the command of `argv`, whose flags are those of `root`.
    pub(crate) fn gather(
        root: &Command,
        argv: Vec<OsString>,
        env: impl Fn(&OsStr) -> Option<OsString>,
    ) -> Self {
        let name = argv.get(1).and_then(|name| name.to_str()).unwrap_or_default().to_owned();
        let command = root.find_subcommand(&name).filter(|_| COMMANDS.contains(&&*name));
        let asks_for_help =
            argv.iter().any(|arg| ["--help", "-h"].contains(&&*arg.to_string_lossy()));
        let Some(command) = command.filter(|_| !asks_for_help) else {
            return Self { argv, ..Self::default() };
        };
        let mut found = Self { argv, table: name, ..Self::default() };
        let flags = from_flags(command, found.argv.get(2..).unwrap_or_default());
        let environment = from_environment(command, env);
        let path = flags.get("config").or_else(|| environment.get("config"));
        let file = path.map(|path| found.read_file(command, Path::new(&path.text)));
        let file = file.unwrap_or_default();
        let is_needed =
            |name: &&String| !environment.contains_key(*name) && !flags.contains_key(*name);
        let needed = file.keys().filter(is_needed).filter_map(|name| find(command, name));
        let words: Vec<_> = needed.filter_map(|arg| word_of(arg, file.get(long(arg)))).collect();
        found.argv.splice(2..2, words);
        // The last one that is set holds.
        for (name, setting) in file.into_iter().chain(environment).chain(flags) {
            found.try_out(command, &name, &setting);
            found.set.insert(name, setting);
        }
        // Of what is missing clap tells where nothing else is wrong.
        if !found.faults.is_empty() {
            let is_missing =
                |arg: &&Arg| arg.is_required_set() && !found.set.contains_key(long(arg));
            let missing = command.get_arguments().filter(is_missing);
            let missing = missing.map(|arg| format!("--{}: it is required", long(arg)));
            found.faults.extend(missing.collect::<Vec<_>>());
        }
        found
    }

    /// Reads one value by the parser of its flag.
    fn try_out(&mut self, command: &Command, name: &str, setting: &Setting) {
        let Some(arg) = find(command, name) else { return };
        let alone = arg.clone().env(None::<&str>).required(false);
        let mut words = vec![OsString::from("settings")];
        words.extend(word_of(&alone, Some(setting)));
        if let Err(error) = Command::new("settings").arg(alone).try_get_matches_from(words) {
            let text = error.to_string();
            let text = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
            let value = &*setting.text.to_string_lossy();
            let is_secret = arg.is_hide_env_values_set() && !value.is_empty();
            let text = if is_secret { text.replace(value, "…") } else { text.into() };
            self.faults.push(format!("{}: {text}", setting.place));
        }
    }

    fn read_file(&mut self, command: &Command, path: &Path) -> BTreeMap<String, Setting> {
        let shown = path.display().to_string();
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) => {
                self.faults.push(format!("--config {shown}: {error}"));
                return BTreeMap::new();
            }
        };
        let line = |at: usize| text.get(..at).unwrap_or_default().matches('\n').count() + 1;
        let (document, errors) = DeTable::parse_recoverable(&text);
        for error in errors {
            let at = line(error.span().map_or(0, |span| span.start));
            self.faults.push(format!("{shown}:{at}: {}", error.message()));
        }
        let mut settings = BTreeMap::new();
        for (table, content) in document.get_ref() {
            let place = format!("{shown}:{}", line(table.span().start));
            let name = table.get_ref();
            match content.get_ref() {
                DeValue::Table(_) if COMMANDS.contains(&&**name) && *name != command.get_name() => {
                }
                DeValue::Table(keys) if *name == command.get_name() => {
                    for (key, value) in keys {
                        let place = format!("{shown}:{}", line(key.span().start));
                        match self::read(command, key.get_ref(), value.get_ref()) {
                            Ok((name, Some(text))) => {
                                settings.insert(name, Setting { place, text: text.into() });
                            }
                            Ok((_, None)) => {}
                            Err(fault) => self.faults.push(format!("{place}: {fault}")),
                        }
                    }
                }
                _ => {
                    let text = "settings are in the tables [serve] and [worker]";
                    self.faults.push(format!("{place}: `{name}` is no setting: {text}"));
                }
            }
        }
        settings
    }

    /// A fault that names flags, and where these were set if not on the command line.
    pub(crate) fn with_places(&self, fault: &str) -> String {
        let mut fault = fault.to_owned();
        for (name, setting) in &self.set {
            let flag = format!("--{name}");
            let is_named =
                fault.split(|c: char| c.is_whitespace() || ":,".contains(c)).any(|w| w == flag);
            if is_named && setting.place != flag {
                fault = format!("{fault} ({flag} is set at {})", setting.place);
            }
        }
        fault
    }

    /// All settings as a file that says the same, with the place of each; secrets are left out.
    pub(crate) fn show(&self, root: &Command) -> String {
        let mut shown = format!("[{}]\n", self.table);
        let command = root.find_subcommand(&self.table);
        for arg in
            command.into_iter().flat_map(Command::get_arguments).filter(|arg| is_setting(arg))
        {
            let Some(name) = arg.get_long() else { continue };
            let key = name.replace('-', "_");
            let line = match self.set.get(name) {
                Some(setting) if arg.is_hide_env_values_set() => {
                    format!("# {key} is set at {}, and hidden\n", setting.place)
                }
                Some(setting) => {
                    let value = show_value(arg, &setting.text.to_string_lossy());
                    format!("{key} = {value}  # {}\n", setting.place)
                }
                None => match arg.get_default_values() {
                    [] => format!("# {key} is not set\n"),
                    values => {
                        let values: Vec<_> = values.iter().map(|v| v.to_string_lossy()).collect();
                        format!("{key} = {}  # default\n", show_value(arg, &values.join(",")))
                    }
                },
            };
            shown += &line;
        }
        shown
    }
}

fn find<'a>(command: &'a Command, name: &str) -> Option<&'a Arg> {
    command.get_arguments().find(|arg| arg.get_long() == Some(name))
}

/// It may stand in a file.
fn is_setting(arg: &Arg) -> bool {
    !arg.is_hide_set() && !["config", "print-config", "help", "version"].contains(&long(arg))
}

fn long(arg: &Arg) -> &str {
    arg.get_long().unwrap_or_default()
}

/// A setting as a word of a command line.
fn word_of(arg: &Arg, setting: Option<&Setting>) -> Option<OsString> {
    let mut flag = OsString::from(format!("--{}", long(arg)));
    if arg.get_action().takes_values() {
        flag.push("=");
        flag.push(&setting?.text);
    }
    Some(flag)
}

fn from_flags(command: &Command, words: &[OsString]) -> BTreeMap<String, Setting> {
    let mut settings = BTreeMap::new();
    let mut words = words.iter().peekable();
    while let Some(word) = words.next() {
        let Some(word) = word.to_str().filter(|word| *word != "--") else { continue };
        let (flag, value) = word.split_once('=').map_or((word, None), |(f, v)| (f, Some(v.into())));
        let arg = flag.strip_prefix("--").and_then(|name| find(command, name));
        let Some(arg) = arg else { continue };
        let next = |words: &mut std::iter::Peekable<std::slice::Iter<'_, OsString>>| {
            words.next_if(|word| !word.to_string_lossy().starts_with("--")).cloned()
        };
        let takes_values = arg.get_action().takes_values();
        let value =
            value.or_else(|| if takes_values { next(&mut words) } else { Some("true".into()) });
        // Clap itself tells of a flag without its value.
        let Some(text) = value else { continue };
        settings.insert(long(arg).into(), Setting { place: flag.into(), text });
    }
    settings
}

fn from_environment(
    command: &Command,
    env: impl Fn(&OsStr) -> Option<OsString>,
) -> BTreeMap<String, Setting> {
    let args =
        command.get_arguments().filter_map(|arg| Some((arg, arg.get_long()?, arg.get_env()?)));
    let set = args.filter_map(|(arg, name, variable)| {
        let text = env(variable)?;
        let place = variable.to_string_lossy().into_owned();
        // As clap has it: what says no is no flag.
        let is_flag = matches!(arg.get_action(), ArgAction::SetTrue);
        let says_no = ["", "0", "n", "no", "f", "false", "off"];
        let is_off = is_flag && says_no.contains(&&*text.to_string_lossy().to_lowercase());
        let text = if is_off { "false".into() } else { text };
        Some((name.to_owned(), Setting { place, text }))
    });
    set.collect()
}

/// A key and its value: the flag's name, and the text that would follow it; none for a flag that is off.
fn read(
    command: &Command,
    key: &str,
    value: &DeValue<'_>,
) -> Result<(String, Option<String>), String> {
    let name = key.replace('_', "-");
    let arg = find(command, &name).filter(|arg| is_setting(arg) && !key.contains('-'));
    let help = command.get_name();
    let arg = arg.ok_or_else(|| {
        format!("`{key}` is no setting: they are the flags of `lookalike {help} --help`, with `_` for `-`")
    })?;
    let is_flag = !arg.get_action().takes_values();
    let text = match value {
        DeValue::Boolean(is_on) if is_flag => return Ok((name, is_on.then(|| "true".into()))),
        _ if is_flag => return Err(format!("`{key}` is true or false")),
        DeValue::Array(list) => {
            let parts: Option<Vec<_>> = list.iter().map(|part| scalar(part.get_ref())).collect();
            let parts = parts.filter(|parts| parts.iter().all(|part| !part.contains(',')));
            let parts = parts.filter(|_| arg.get_value_delimiter().is_some());
            parts.ok_or_else(|| format!("`{key}` is no list of such values"))?.join(",")
        }
        value => scalar(value).ok_or_else(|| format!("`{key}` is a text or a number"))?,
    };
    Ok((name, Some(text)))
}

fn scalar(value: &DeValue<'_>) -> Option<String> {
    match value {
        DeValue::String(text) => Some(text.clone().into_owned()),
        DeValue::Integer(number) if number.radix() == 10 => Some(number.as_str().into()),
        DeValue::Float(number) => Some(number.as_str().into()),
        _ => None,
    }
}

fn show_value(arg: &Arg, text: &str) -> String {
    let quoted = |text: &str| toml::Value::String(text.into()).to_string();
    if arg.get_value_delimiter().is_some() {
        let parts: Vec<_> = text.split(',').map(quoted).collect();
        return format!("[{}]", parts.join(", "));
    }
    let is_bare = !arg.get_action().takes_values()
        || text.parse::<i64>().is_ok_and(|number| number.to_string() == text);
    if is_bare { text.into() } else { quoted(text) }
}

#[cfg(test)]
mod tests;
