#!/bin/sh
# Start the small agent: small_agent.sh MISSION_FILE. MicroPython has no signal handlers, so this program passes SIGTERM
# and SIGINT on as a line on standard input, through a pipe without a name.
pipe=$(mktemp -u)
mkfifo -m 600 "$pipe" && exec 3<>"$pipe" && rm "$pipe" || exit 2
(trap '' TERM INT; exec micropython "$(dirname "$0")/small_agent.py" "$1" <&3 3<&-) &
agent=$!
trap 'echo end >&3' TERM INT
while :; do
  wait $agent
  status=$?
  kill -0 $agent 2>/dev/null || exit $status
done
