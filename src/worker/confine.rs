//! What a worker process takes from itself before it reads a model of somebody else's.
//!
//! 1. Memory and open files are limited, and it leaves no core file: what a model asks for too much of
//!    ends this process and no other.
//! 2. No program that it starts can have more rights than it has.
//! 3. A worker on its server's Unix socket has no other sockets: no network, and no way around that
//!    through `io_uring`; nor may it look into other processes.
//!
//! What the kernel does not permit is told in the log, and the worker goes on.

use std::io;

use rustix::{
    process::{Resource, Rlimit, getrlimit, setrlimit},
    thread::set_no_new_privs,
    time::{ClockId, clock_gettime},
};
use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter,
    SeccompRule,
};

/// Graphics drivers hold some hundred.
const OPEN_FILES: u64 = 4096;

/// Sockets that remain: the one to the server, and the kernel's news of devices.
const SOCKETS: [i32; 2] = [libc::AF_UNIX, libc::AF_NETLINK];

/// Calls that no worker needs, and that would lead past these limits.
const DENIED: [i64; 7] = [
    libc::SYS_io_uring_setup,
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_bpf,
    libc::SYS_userfaultfd,
    libc::SYS_perf_event_open,
];

/// Limits what this process may use, and says what could not be limited. 0 MiB is no limit.
pub fn limit_resources(memory_mib: u64) {
    let bytes = memory_mib.checked_mul(1 << 20).filter(|&bytes| bytes > 0);
    // `Data` counts what is written to, unlike `As`: drivers set aside far more than they use.
    let limits = [
        ("memory", Resource::Data, bytes),
        ("open files", Resource::Nofile, Some(OPEN_FILES)),
        ("core files", Resource::Core, Some(0)),
    ];
    for (what, resource, most) in limits {
        if let Some(Err(error)) = most.map(|most| lower(resource, most)) {
            tracing::warn!(%error, "{what} of this worker cannot be limited");
        }
    }
    if let Err(error) = set_no_new_privs(true) {
        tracing::warn!(%error, "programs that this worker starts may gain rights");
    }
}

/// Lowers a limit for good; one that is lower already stays.
fn lower(resource: Resource, most: u64) -> io::Result<()> {
    let now = getrlimit(resource);
    let least = |limit: Option<u64>| Some(limit.map_or(most, |limit| limit.min(most)));
    let limit = Rlimit { current: least(now.current), maximum: least(now.maximum) };
    Ok(setrlimit(resource, limit)?)
}

/// Gives the next job so many seconds of processor time; the process that uses more is ended by the
/// kernel. 0 is no limit.
pub fn grant_cpu(secs: u64) {
    if secs == 0 {
        return;
    }
    let used = clock_gettime(ClockId::ProcessCPUTime).tv_sec;
    let maximum = getrlimit(Resource::Cpu).maximum;
    let current = (used as u64).saturating_add(secs);
    let current = Some(maximum.map_or(current, |maximum| current.min(maximum)));
    if let Err(error) = setrlimit(Resource::Cpu, Rlimit { current, maximum }) {
        tracing::warn!(%error, "processor time of this worker cannot be limited");
    }
}

/// Takes the network from all threads of this process, and what would lead past that.
pub fn leave_the_network() {
    let applied = filter().and_then(|filter| seccompiler::apply_filter_all_threads(&filter));
    if let Err(error) = applied {
        tracing::warn!(%error, "this worker cannot leave the network");
    }
}

fn filter() -> Result<BpfProgram, seccompiler::Error> {
    let is_other = |family: &i32| {
        let family = *family as u64;
        SeccompCondition::new(0, SeccompCmpArgLen::Dword, SeccompCmpOp::Ne, family)
    };
    let others = SOCKETS.iter().map(is_other).collect::<Result<Vec<_>, _>>()?;
    let others = SeccompRule::new(others)?;
    // A call without a rule of its own is denied whatever its arguments.
    let denied = DENIED.map(|call| (call, Vec::new()));
    let rules = denied.into_iter().chain([(libc::SYS_socket, vec![others])]).collect();
    let refused = SeccompAction::Errno(libc::EACCES as u32);
    let architecture = std::env::consts::ARCH.try_into()?;
    let filter = SeccompFilter::new(rules, SeccompAction::Allow, refused, architecture)?;
    Ok(filter.try_into()?)
}

#[cfg(test)]
mod tests {
    use std::{
        net::{TcpListener, TcpStream, UdpSocket},
        os::unix::net::UnixStream,
    };

    use super::*;

    #[test]
    fn without_the_network_only_local_sockets_remain() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        // The filter is for this thread alone, which ends with the test.
        let confined = std::thread::spawn(move || {
            seccompiler::apply_filter(&filter().unwrap()).unwrap();
            let tcp = TcpStream::connect(address).map(drop);
            let udp = UdpSocket::bind("127.0.0.1:0").map(drop);
            (tcp, udp, UnixStream::pair().map(drop))
        });
        let (tcp, udp, unix) = confined.join().unwrap();
        assert_eq!(tcp.unwrap_err().kind(), io::ErrorKind::PermissionDenied);
        assert_eq!(udp.unwrap_err().kind(), io::ErrorKind::PermissionDenied);
        unix.unwrap();
        TcpStream::connect(address).unwrap();
    }
}
