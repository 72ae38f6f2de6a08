//! Keeps Mesa from complaining at the terminal.

use std::{env, os::unix::process::CommandExt, path::Path, process::Command};

/// Mesa asks for a compositor whenever it looks for devices, and complains where this names no folder.
const VARIABLE: &str = "XDG_RUNTIME_DIR";
/// A folder in which nobody who shares the machine can put a compositor's socket.
const FOLDER: &str = "/proc";

/// Where the variable is not set, starts this program over in this process, with the variable set: an environment must
/// not change while threads run. Returns where the variable is set, which it is after that, or if the program cannot be
/// started, which costs no more than the complaint.
pub(crate) fn start_over() {
    let folder = env::var_os(VARIABLE).unwrap_or_default();
    let (Ok(program), false) = (env::current_exe(), Path::new(&folder).is_absolute()) else {
        return;
    };
    let mut arguments = env::args_os();
    let mut command = Command::new(program);
    command.arg0(arguments.next().unwrap_or_default()).args(arguments).env(VARIABLE, FOLDER);
    let _ = command.exec();
}
