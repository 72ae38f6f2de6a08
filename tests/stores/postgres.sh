# A PostgreSQL cluster in a temporary folder, for as long as somebody holds this script's input.
# Says where its socket is, or nothing when PostgreSQL is missing; then obeys one order a line:
# create NAME (a database), stop, start, crash (SIGKILL, and a new start), freeze and thaw (SIGSTOP and
# SIGCONT, all of its processes). Not to be run as root.
set -eu
PATH=$(ls -d /usr/lib/postgresql/*/bin 2>/dev/null | sort -V | tail -n 1):$PATH
command -v initdb >/dev/null || exit 0
dir=$(mktemp -d)
cd "$dir"
begin() {
    # Everything as in production but the room it takes.
    pg_ctl start -D data -w -l log -o "-k $dir -c listen_addresses= -c fsync=on -c shared_buffers=16MB \
        -c max_connections=200" >/dev/null
}
# The postmaster first when it stops: it begins no process then that would be missed.
each() {
    postmaster=$(head -n 1 data/postmaster.pid)
    # shellcheck disable=SC2046  # a list of numbers
    kill "$1" "$postmaster" $(pgrep -P "$postmaster") 2>/dev/null || :
}
end() {
    each -CONT
    pg_ctl stop -D data -m "$1" >/dev/null 2>&1 || :
}
trap 'end immediate; rm -rf "$dir"' EXIT
# English order, so that nothing relies on the order of bytes by chance.
initdb -D data -U lookalike -A trust -E UTF8 --no-sync --locale=C.UTF-8 --locale-provider=icu \
    --icu-locale=en >init.log 2>&1 || { cat init.log >&2; exit 1; }
begin
echo "$dir"
while read -r order name; do
    case $order in
        create) createdb -h "$dir" -U lookalike "$name" ;;
        stop) end fast ;;
        start) begin ;;
        freeze) each -STOP ;;
        thaw) each -CONT ;;
        crash)
            kill -9 "$(head -n 1 data/postmaster.pid)"
            # Its children notice and end.
            while pgrep -F data/postmaster.pid >/dev/null 2>&1; do sleep 0.05; done
            sleep 0.5
            rm -f data/postmaster.pid
            begin
            ;;
    esac
    echo done
done
