#!/bin/bash
# The steps of the Dockerfile. They run in any clean system with apt and Python 3.10 or later:
#   steps.sh list              the Debian packages of package.xml, by rosdep
#   steps.sh install FILE      installs the packages that a file lists
#   steps.sh build PREFIX      colcon build of the checkout that holds this file
#   steps.sh run COMMAND...    runs a command with ROS 2, where there is one, and the package
set -euo pipefail
prefix=/opt/imu_calibration
checkout=$(cd "$(dirname "$0")/.." && pwd)

source_all() {
    set +u  # setup files read variables that may be unset
    for file in "/opt/ros/${ROS_DISTRO:-jazzy}/setup.bash" "$prefix/setup.bash"; do
        # shellcheck disable=SC1090
        if [ -f "$file" ]; then . "$file"; fi
    done
    set -u
}

case ${1:-} in
list)
    apt-get update -qq
    rosdep update --rosdistro "$ROS_DISTRO" >&2
    rosdep keys --from-paths "$checkout" --ignore-src --dependency-types=exec |
        xargs -n1 rosdep resolve --rosdistro "$ROS_DISTRO" | grep -v '^#'
    ;;
install)
    apt-get update -qq
    xargs -a "$2" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends
    rm -rf /var/lib/apt/lists/*
    ;;
build)
    source_all
    work=$(mktemp -d)
    colcon --log-base "$work/log" build --base-paths "$checkout" --build-base "$work/build" \
        --install-base "$2" --merge-install
    rm -rf "$work"
    ;;
run)
    shift
    source_all
    exec "$@"
    ;;
*)
    sed -n '2,6s/^# \{0,1\}//p' "$0" >&2
    exit 1
    ;;
esac
