#!/bin/bash
# Write debian/ for ROS 2 Jazzy on Ubuntu 24.04 into OUTPUT with bloom-generate, without a network:
# the keys of package.xml are resolved by test/project/rosdep_noble.yaml.
#
# Usage: rosdebian.sh BIN OUTPUT; BIN holds bloom-generate and rosdep.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
bin=$(cd "$1" && pwd)
mkdir -p "$2"
output=$(cd "$2" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

# An index with one distribution that has no packages, and one list of keys.
mkdir -p "$folder/jazzy" "$folder/lists" "$folder/home" "$folder/package"
cat >"$folder/index.yaml" <<END
distributions:
  jazzy:
    distribution: [jazzy/distribution.yaml]
    distribution_cache: file://$folder/jazzy/cache.yaml
    distribution_status: active
    distribution_type: ros2
    python_version: 3
type: index
version: 4
END
cat >"$folder/jazzy/distribution.yaml" <<END
release_platforms: {ubuntu: [noble]}
repositories: {}
type: distribution
version: 2
END
cat >"$folder/jazzy/cache.yaml" <<END
distribution_file:
- {release_platforms: {ubuntu: [noble]}, repositories: {}, type: distribution, version: 2}
name: jazzy
release_package_xmls: {}
source_repo_package_xmls: {}
type: cache
version: 2
END
echo "yaml file://$root/test/project/rosdep_noble.yaml" >"$folder/lists/20-default.list"
cp "$root/package.xml" "$root/CHANGELOG.rst" "$root/LICENSE" "$folder/package"

export HOME=$folder/home PATH=$bin:$PATH
export ROSDISTRO_INDEX_URL=file://$folder/index.yaml ROSDEP_SOURCE_PATH=$folder/lists
rosdep update >"$folder/log" 2>&1 || { cat "$folder/log" >&2; exit 1; }
cd "$folder/package"
git init --quiet .
bloom-generate rosdebian --os-name ubuntu --os-version noble --ros-distro jazzy \
  </dev/null >"$folder/log" 2>&1 || { cat "$folder/log" >&2; exit 1; }
cp -r debian "$output"
grep '^Depends:' debian/control
