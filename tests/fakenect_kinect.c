/* Preloaded over Debian's fakenect 0.5.3, which replays dumps and knows 11-bit depth and RGB only: lets it
   give depth in mm and IR, adds the calls it lacks, and makes the Kinect something that can be unplugged:
   it is there while the file $FAKENECT_PLUGGED exists. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <libfreenect.h>
#include <libfreenect_registration.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static int was_there, died;

static int there(void) { return access(getenv("FAKENECT_PLUGGED"), F_OK) == 0; }

freenect_frame_mode freenect_find_depth_mode(freenect_resolution resolution, freenect_depth_format format) {
  freenect_frame_mode mode = {256, resolution, {0}, 640 * 480 * 2, 640, 480, 16, 0, 30, 1};
  mode.depth_format = format;
  return mode;
}

freenect_frame_mode freenect_find_video_mode(freenect_resolution resolution, freenect_video_format format) {
  freenect_frame_mode mode = {256, resolution, {0}, 640 * 488 * 2, 640, 488, 10, 6, 30, 1};
  mode.video_format = format;
  return mode;
}

int freenect_num_devices(freenect_context *context) { return (void)context, there(); }

int freenect_list_device_attributes(freenect_context *context, struct freenect_device_attributes **list) {
  (void)context;
  *list = NULL;
  if (!there()) return 0;
  *list = calloc(1, sizeof **list);
  (*list)->camera_serial = strdup("A00366800000000A");
  return 1;
}

void freenect_free_device_attributes(struct freenect_device_attributes *list) {
  free((char *)list->camera_serial);
  free(list);
}

int freenect_open_device_by_camera_serial(freenect_context *context, freenect_device **device, const char *serial) {
  if (!there() || strcmp(serial, "A00366800000000A") != 0) return -1;
  was_there = 1;
  died = 0;
  return freenect_open_device(context, device, 0);
}

/* As the real one: fails from when the device has vanished until it is closed, also if another came. */
int freenect_process_events_timeout(freenect_context *context, struct timeval *timeout) {
  static int (*real)(freenect_context *, struct timeval *);
  if (!real) *(void **)&real = dlsym(RTLD_NEXT, "freenect_process_events_timeout");
  if (was_there && !there()) died = 1;
  return died ? -1 : real(context, timeout);
}

int freenect_set_flag(freenect_device *device, freenect_flag flag, freenect_flag_value value) {
  return (void)device, (void)flag, value == FREENECT_OFF ? 0 : -1;
}

freenect_registration freenect_copy_registration(freenect_device *device) {
  (void)device;
  freenect_registration told;
  memset(&told, 0, sizeof told);
  told.zero_plane_info.reference_distance = 120.0f;
  told.zero_plane_info.reference_pixel_size = 0.1042f;
  return told;
}

int freenect_destroy_registration(freenect_registration *told) { return (void)told, 0; }
