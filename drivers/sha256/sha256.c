#include "pipefish/drivers/sha256.h"

#include <openssl/evp.h>

pf_status pf_sha256(const void *bytes, size_t n, uint8_t out[32])
{
    return EVP_Digest(bytes, n, out, NULL, EVP_sha256(), NULL) == 1 ? PF_OK : PF_ERR_IO;
}

pf_status pf_sha256_image(const pf_image *image, uint8_t out[32])
{
    if (image->data == NULL || image->width == 0 || image->height == 0 || image->stride < image->width)
        return PF_ERR_ARGUMENT;
    if (image->stride == image->width)
        return pf_sha256(image->data, (size_t)image->width * image->height, out);
    EVP_MD_CTX *context = EVP_MD_CTX_new();
    if (context == NULL)
        return PF_ERR_IO;
    int ok = EVP_DigestInit_ex(context, EVP_sha256(), NULL);
    for (uint32_t y = 0; y < image->height && ok == 1; y++)
        ok = EVP_DigestUpdate(context, image->data + (size_t)y * image->stride, image->width);
    if (ok == 1)
        ok = EVP_DigestFinal_ex(context, out, NULL);
    EVP_MD_CTX_free(context);
    return ok == 1 ? PF_OK : PF_ERR_IO;
}
