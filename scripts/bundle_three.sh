#!/bin/sh
# Bundle the parts of three.js that the 3D viewer uses into one script that also loads from the file system.
#     scripts/bundle_three.sh 0.187.0      needs npm and the network; then adapt VENDORED in scripts/licences.py
set -eu
version=$1
static=$(cd "$(dirname "$0")/../src/subiaco_report/subiaco_report/viewer/static" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init --yes >/dev/null
npm install "three@$version" esbuild@0.28 >/dev/null
cat >entry.js <<'END'
export {
  Box3, BufferAttribute, BufferGeometry, ColorManagement, DataTexture, DepthTexture, Frustum, GLSL3,
  LinearSRGBColorSpace, LineBasicMaterial, LineSegments, MathUtils, Matrix4, Mesh, NearestFilter,
  PerspectiveCamera, Points, RGBAFormat, REVISION, Scene, ShaderMaterial, UnsignedByteType, UnsignedIntType,
  Vector2, Vector3, WebGLRenderTarget, WebGLRenderer,
} from "three";
export { MapControls } from "three/examples/jsm/controls/MapControls.js";
END
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --target=es2020 \
    --legal-comments=inline --outfile="$static/three.min.js" \
    --banner:js="/* three.js $version, https://threejs.org, MIT licence: see three.LICENSE.txt beside this file. */"
cp node_modules/three/LICENSE "$static/three.LICENSE.txt"
