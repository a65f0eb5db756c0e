// A model-based tracker of ViSP over grey frames from standard input.
//
//   edge_tracker MODEL.cao pose|position WIDTH HEIGHT FX FY CX CY X Y Z
//
// Frames are WIDTH x HEIGHT bytes each; X, Y, Z is the first place in metres, the model facing the camera. One line
// comes back per frame: whether it was tracked (1 or 0), x, y, z, projection error in degrees, CPU time in seconds.
//
// "pose" is vpMbGenericTracker over edges and keypoints. "position" holds the rotation fixed, which the generic tracker
// of ViSP 3.5 does not (it sets its estimated degrees of freedom back to all six), but its predecessor does.

#include <cstdio>
#include <ctime>
#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <utility>

#include <visp3/mbt/vpMbEdgeKltTracker.h>
#include <visp3/mbt/vpMbGenericTracker.h>

namespace {

const char *const FACE = "rear";  // the model's face: keypoints lie on it, its own border is no edge

struct Settings {
  unsigned int range;  // px searched for an edge, to both sides
  double threshold;    // of an edge's likelihood
};

// Each the best of its kind on seeds 7000 to 7011 of the chase clips; benchmarks/README.md has the figures.
const Settings POSE{5, 20000.0}, POSITION{6, 10000.0};

vpMe movingEdges(const Settings &settings) {
  vpMe edges;
  edges.setMaskSize(5);
  edges.setMaskNumber(180);
  edges.setRange(settings.range);
  edges.setThreshold(settings.threshold);
  edges.setMu1(0.5);
  edges.setMu2(0.5);
  edges.setSampleStep(1);
  return edges;
}

vpKltOpencv keypoints() {
  vpKltOpencv points;
  points.setMaxFeatures(300);
  points.setWindowSize(7);
  points.setQuality(0.005);
  points.setMinDistance(4);
  points.setHarrisFreeParameter(0.01);
  points.setBlockSize(3);
  points.setPyramidLevels(3);
  return points;
}

template <typename Tracker>
std::unique_ptr<Tracker> prepared(std::unique_ptr<Tracker> tracker, const Settings &settings) {
  tracker->setMovingEdge(movingEdges(settings));
  tracker->setKltOpencv(keypoints());
  tracker->setKltMaskBorder(2);
  return tracker;
}

void useLinesOnly(vpMbGenericTracker &tracker) { tracker.setUseEdgeTracking(FACE, false); }
void useLinesOnly(vpMbEdgeKltTracker &tracker) { tracker.vpMbEdgeTracker::setUseEdgeTracking(FACE, false); }

template <typename Tracker>
std::unique_ptr<vpMbTracker> loaded(std::unique_ptr<Tracker> tracker, const std::string &model,
                                    const vpCameraParameters &camera) {
  tracker->setCameraParameters(camera);
  tracker->setAngleAppear(vpMath::rad(70));
  tracker->setAngleDisappear(vpMath::rad(80));
  tracker->setNearClippingDistance(0.1);
  tracker->setFarClippingDistance(200.0);
  tracker->setClipping(tracker->getClipping() | vpMbtPolygon::FOV_CLIPPING);
  tracker->setOptimizationMethod(vpMbTracker::LEVENBERG_MARQUARDT_OPT);
  tracker->setProjectionErrorComputation(true);
  tracker->loadModel(model);
  useLinesOnly(*tracker);
  return tracker;
}

std::unique_ptr<vpMbTracker> poseTracker(const std::string &model, const vpCameraParameters &camera) {
  const int features = vpMbGenericTracker::EDGE_TRACKER | vpMbGenericTracker::KLT_TRACKER;
  return loaded(prepared(std::make_unique<vpMbGenericTracker>(1, features), POSE), model, camera);
}

std::unique_ptr<vpMbTracker> positionTracker(const std::string &model, const vpCameraParameters &camera) {
  vpColVector freedom(6, 0.0);
  freedom[0] = freedom[1] = freedom[2] = 1.0;
  auto tracker = prepared(std::make_unique<vpMbEdgeKltTracker>(), POSITION);
  tracker->setEstimatedDoF(freedom);
  return loaded(std::move(tracker), model, camera);
}

double cpuSeconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

void follow(vpMbTracker &tracker, vpImage<unsigned char> &image, vpHomogeneousMatrix pose) {
  for (bool first = true; std::fread(image.bitmap, 1, image.getSize(), stdin) == image.getSize(); first = false) {
    const double begun = cpuSeconds();
    bool tracked = true;
    try {
      if (first)
        tracker.initFromPose(image, pose);
      tracker.track(image);
      tracker.getPose(pose);
    } catch (const std::exception &) {  // of ViSP, or of OpenCV under it
      tracked = false;
    }
    const double spent = cpuSeconds() - begun;
    std::printf("%d %.6f %.6f %.6f %.3f %.7f\n", tracked, pose[0][3], pose[1][3], pose[2][3],
                tracker.getProjectionError(), spent);
    std::fflush(stdout);
  }
}

}  // namespace

int main(int argc, char **argv) {
  if (argc != 12) {
    std::cerr << "expected MODEL.cao pose|position WIDTH HEIGHT FX FY CX CY X Y Z\n";
    return 2;
  }
  std::cout.rdbuf(nullptr);  // ViSP talks on standard output, which is the results'
  try {
    const std::string model = argv[1], kind = argv[2];
    const auto number = [&](int i) { return std::stod(argv[i]); };
    vpCameraParameters camera;
    camera.initPersProjWithoutDistortion(number(5), number(6), number(7), number(8));
    vpImage<unsigned char> image(std::stoul(argv[4]), std::stoul(argv[3]));
    const auto tracker = kind == "pose" ? poseTracker(model, camera) : positionTracker(model, camera);
    follow(*tracker, image, vpHomogeneousMatrix(number(9), number(10), number(11), 0, 0, 0));
  } catch (const std::exception &error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
  return 0;
}
